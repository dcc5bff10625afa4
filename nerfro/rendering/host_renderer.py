"""Copy on the CPU of the parts of a model that make rays, paths and samples."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from nerfro.core.variants import variant
from nerfro.rendering.renderer import Renderer


class HostRenderer:
    """Copy of the camera model, the medium and the samplers of a model on another device, for compiled kernels.

    Refined cameras and the density grid change during training, and the copy follows them. Parameters that gradient
    descent learns keep their first values, because they change neither paths nor samples (`Renderer.traces_on_cpu`).

    Args:
        renderer: the model.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._original = renderer
        self._copy()

    @torch.no_grad()
    def updated(self) -> Renderer:
        """Return the copy, whose field and background stay on the other device, with the current values."""
        tensors = self._tensors()
        if [*map(id, tensors)] != [*map(id, self._copied)]:  # a buffer or a module has been replaced
            self._copy()
        for number, (tensor, own) in enumerate(zip(tensors, self._copies, strict=True)):
            if not tensor.requires_grad and tensor._version != self._versions[number]:  # a copy waits for the device
                own.copy_(tensor)
                self._versions[number] = tensor._version
        return self._renderer

    def _copy(self) -> None:
        tensors = self._tensors()
        copies = [tensor.detach().cpu() for tensor in tensors]
        memo: dict[int, Any] = {id(tensor): own for tensor, own in zip(tensors, copies, strict=True)}
        camera, medium, path_sampler, point_sampler = copy.deepcopy(self._parts(), memo)
        scene = variant(self._original.scene, camera=camera, medium=medium, _on_device=torch.empty(0))
        self._renderer = variant(self._original, scene=scene, path_sampler=path_sampler, point_sampler=point_sampler)
        self._copied, self._copies = tensors, copies
        self._versions = [tensor._version for tensor in tensors]

    def _parts(self) -> nn.ModuleList:
        scene = self._original.scene
        return nn.ModuleList([scene.camera, scene.medium, self._original.path_sampler, self._original.point_sampler])

    def _tensors(self) -> list[Tensor]:
        parts = self._parts()
        return [*parts.parameters(), *parts.buffers()]
