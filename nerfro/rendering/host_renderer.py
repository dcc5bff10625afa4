"""Copy on the CPU of the parts of a model that make rays, paths and samples."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn

from nerfro.core.variants import variant
from nerfro.rendering.renderer import Renderer


class HostRenderer:
    """Copy of the camera model, the medium and the samplers of a model on another device, for compiled kernels.

    Refined cameras and the density grid change during training, and the copy follows them. Parameters that gradient
    descent learns keep their first values, because they change neither paths nor samples (`Renderer.kernels_trace`).

    Args:
        renderer: the model.
    """

    def __init__(self, renderer: Renderer) -> None:
        scene = renderer.scene
        parts = nn.ModuleList([scene.camera, scene.medium, renderer.path_sampler, renderer.point_sampler])
        tensors = [*parts.parameters(), *parts.buffers()]
        copies = [tensor.detach().cpu() for tensor in tensors]
        memo: dict[int, Any] = {id(tensor): own for tensor, own in zip(tensors, copies, strict=True)}
        camera, medium, path_sampler, point_sampler = copy.deepcopy(parts, memo)
        scene = variant(scene, camera=camera, medium=medium, _on_device=torch.empty(0))
        self._renderer = variant(renderer, scene=scene, path_sampler=path_sampler, point_sampler=point_sampler)
        self._fixed = [pair for pair in zip(tensors, copies, strict=True) if not pair[0].requires_grad]
        self._versions = [original._version for original, _ in self._fixed]

    @torch.no_grad()
    def updated(self) -> Renderer:
        """Return the copy, whose field and background stay on the other device, with the current values."""
        for number, (original, own) in enumerate(self._fixed):
            if original._version != self._versions[number]:  # a copy waits for the device
                own.copy_(original)
                self._versions[number] = original._version
        return self._renderer
