"""Camera model that keeps the cameras of the data set."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from nerfro.camera.base import CameraModel
from nerfro.core.rays import Rays
from nerfro.registry.registration import register


@register("camera", "given")
class GivenCamera(CameraModel):
    """Keep the cameras of the data set.

    Args:
        exposure: whether to estimate a gain for each training view and colour channel.
    """

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """Return the rays unchanged."""
        return rays
