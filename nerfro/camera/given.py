"""Camera model that keeps the cameras of the data set."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from nerfro.camera.base import CameraModel
from nerfro.core.rays import Rays
from nerfro.registry.allowed import Natural
from nerfro.registry.registration import register


@register("camera", "given")
class GivenCamera(CameraModel):
    """Keep the cameras of the data set.

    Args:
        exposure: whether to estimate a gain for each training view and colour channel.
        appearance: size of the embedding of each training view, from which a smooth gain over its image is learned, in
            addition to its exposure; 0 for none.
    """

    def __init__(self, exposure: bool = False, appearance: Natural = 0) -> None:
        super().__init__(exposure, appearance)

    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """Return the rays unchanged."""
        return rays
