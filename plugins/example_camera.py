"""Template: a camera model of your own in one file. Use it with `camera=shifted`."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Int
from torch import Tensor, nn

from nerfro.parts import CameraModel, Cameras, Rays, register


@register("camera", "shifted")
class Shifted(CameraModel):
    """Estimate one translation of all training cameras.

    Args:
        exposure: whether to estimate a gain for each training view.
    """

    moves = True

    def __init__(self, exposure: bool = False) -> None:
        super().__init__(exposure)
        self.shift = nn.Parameter(torch.zeros(3))  # world units

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        return dataclasses.replace(rays, origins=rays.origins + self.shift)

    def estimated(self, cameras: Cameras) -> Cameras:
        poses = cameras.camera_to_world.clone()
        poses[..., 3] += self.shift.detach().to(poses)
        return dataclasses.replace(cameras, camera_to_world=poses)

    def aligned(self, cameras: Cameras) -> Cameras:
        return self.estimated(cameras)  # test cameras are shifted like the training cameras
