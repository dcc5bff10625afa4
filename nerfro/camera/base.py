"""Camera models: the interface for estimated poses, lens and exposures, and the model that keeps the cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.camera.exposure import Exposure
from nerfro.core.cameras import Cameras
from nerfro.core.rays import Rays
from nerfro.registry.allowed import Natural
from nerfro.registry.registration import register


class CameraModel(nn.Module, ABC):
    """Estimated poses, lens and exposures of the training views. Derive from this class to add a camera model.

    Gradient descent learns the exposures; poses and lens are moved by the phase `cameras`.

    Args:
        exposure: whether to estimate a gain for each training view.
        appearance: size of the embedding of each training view, from which a smooth gain over its image is learned, in
            addition to its exposure; 0 for none.

    Attributes:
        moves: whether the model changes the poses or the lens of the data set.
    """

    moves = False

    def __init__(self, exposure: bool = False, appearance: int = 0) -> None:
        super().__init__()
        self.exposure = Exposure(appearance) if exposure or appearance else None

    def begin(self, cameras: Cameras) -> None:
        """Initialize the model for the training views, given the cameras of the data set."""
        if self.exposure is not None:
            self.exposure.begin(cameras)

    @abstractmethod
    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """Map rays of the cameras of the data set to rays of the estimated cameras.

        Args:
            rays: rays in world units.
            view: index of the training view of each ray.
        """

    def gains(self, view: Int[Tensor, "R"], rays: Rays) -> Float[Tensor, "R 3"] | None:
        """Return the gain of linear radiance of each ray's photograph, or None if exposures are not estimated."""
        return None if self.exposure is None else self.exposure(view, rays)

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        """Return the parameters that gradient descent learns by name, see `Scene.parameters_by_name`."""
        return {f"cameras.{name.removesuffix('.log_gain')}": value for name, value in self.named_parameters()}

    def estimated(self, cameras: Cameras) -> Cameras:
        """Return the estimated training cameras, given those of the data set."""
        return cameras

    def aligned(self, cameras: Cameras) -> Cameras:
        """Apply the similarity transformation between the given and the estimated training cameras to other cameras."""
        return cameras

    def measurements(self) -> dict[str, float]:
        """Return estimated physical quantities by name, for the log."""
        return {} if self.exposure is None else {"cameras.gain_spread": self.exposure.spread}


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
