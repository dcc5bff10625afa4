"""What a camera part is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.camera.exposure import Exposure
from nerfro.cameras import Cameras
from nerfro.rays import Rays


class Camera(nn.Module, ABC):
    """What is believed of the training views: their rays before they are traced, and how bright they were taken.

    What it learns is a part of the model.

    Args:
        exposure: whether each training view has a gain of its own.
    """

    moves = False  # whether cameras are believed to be elsewhere than the data say

    def __init__(self, exposure: bool = False) -> None:
        super().__init__()
        self.exposure = Exposure() if exposure else None

    def begin(self, cameras: Cameras, exposures: Float[Tensor, "V"] | None = None) -> None:
        """Look at the training views before anything learns.

        Args:
            cameras: as the data give them.
            exposures: how bright each view was taken, in any unit, where files tell.
        """
        if self.exposure is not None:
            self.exposure.begin(len(cameras), exposures)

    @abstractmethod
    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """The rays of views as they are believed to be, given those of the data's cameras."""

    def gains(self, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"] | None:
        """By which factors photographs are brighter than the scene, in linear radiance; None where all are alike."""
        return None if self.exposure is None else self.exposure(view)

    def bending_parameters(self) -> list[nn.Parameter]:
        """What rays depend on, of all that learns."""
        brightness = set(self.brightness_parameters())
        return [parameter for parameter in self.parameters() if parameter not in brightness]

    def brightness_parameters(self) -> list[nn.Parameter]:
        """What the views' gains depend on."""
        return [] if self.exposure is None else list(self.exposure.parameters())

    def believed(self, cameras: Cameras) -> Cameras:
        """The training cameras as they are believed to be, given those of the data."""
        return cameras

    def aligned(self, cameras: Cameras) -> Cameras:
        """Other cameras of the data, moved as the training cameras were on the whole."""
        return cameras

    def learned(self) -> dict[str, float]:
        """Physical quantities that learn, by names for the log."""
        return {} if self.exposure is None else {"gain_spread": self.exposure.spread}
