"""Cameras as the data give them."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from nerfro.camera.base import Camera
from nerfro.rays import Rays
from nerfro.registry import register


@register("camera", "given")
class GivenCamera(Camera):
    """Rays stay as the data's cameras give them.

    Args:
        exposure: whether each training view has a gain of its own, for each colour channel.
    """

    def __init__(self, exposure: bool = False) -> None:
        super().__init__(exposure)

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """The same rays."""
        return rays
