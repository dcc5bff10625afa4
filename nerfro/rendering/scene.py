"""The scene: all learned parameters of the world."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from nerfro.boundaries.base import Boundary
from nerfro.camera.base import Camera
from nerfro.camera.given import GivenCamera
from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.media.base import Medium
from nerfro.rendering.colour_space import ColourSpace


class Scene(nn.Module):
    """Refractive medium, radiance fields, background and estimated cameras.

    Args:
        medium: refractive index and absorption.
        fields: radiance fields inside the volume, coarsest sampling level first, or one field for all levels.
        boundary: background radiance, from beyond the volume.
        camera: estimate of the training cameras; by default the cameras of the data set.
        colour_space: colour space of the radiance of fields and background.

    Raises:
        NerfroError: exposures are learned, which needs linear radiance, but the colour space is sRGB.
    """

    def __init__(
        self,
        medium: Medium,
        fields: Sequence[Field],
        boundary: Boundary,
        camera: Camera | None = None,
        colour_space: ColourSpace = ColourSpace.LINEAR,
    ) -> None:
        super().__init__()
        self.camera = GivenCamera() if camera is None else camera
        self.medium, self.fields, self.boundary = medium, nn.ModuleList(fields), boundary
        self.colour_space = colour_space
        if colour_space is ColourSpace.SRGB and self.camera.exposure is not None:
            raise NerfroError("camera.exposure=true needs linear radiance; take model.colour=linear")
        self.register_buffer("_on_device", torch.empty(0), persistent=False)  # a scene may have no other tensor

    def __repr__(self) -> str:
        fields = ", ".join(type(field).__name__ for field in self.fields)
        num_parameters = sum(parameter.numel() for parameter in self.parameters())
        return (
            f"Scene(medium={self.medium}, fields=[{fields}], boundary={type(self.boundary).__name__}, "
            f"camera={type(self.camera).__name__}, {self.colour_space.value}, {num_parameters:,} parameters)"
        )

    @property
    def device(self) -> torch.device:
        """Device of all parameters and buffers."""
        on_device: torch.Tensor = self._on_device  # type: ignore[assignment]
        return on_device.device

    def path_parameters(self) -> list[nn.Parameter]:
        """Return the parameters on which paths depend: of the cameras, and of the index and surfaces of the medium."""
        return [*self.camera.bending_parameters(), *self.medium.bending_parameters()]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return all parameters by the name of their optimizer group."""
        bending = self.medium.bending_parameters()
        return {
            "fields": list(self.fields.parameters()),
            "boundary": list(self.boundary.parameters()),
            "medium": bending,
            "absorption": [own for own in self.medium.parameters() if all(own is not other for other in bending)],
            "camera": self.camera.bending_parameters(),
            "exposure": self.camera.brightness_parameters(),
        }

    def measurements(self) -> dict[str, float]:
        """Return learned physical quantities, such as refractive indices, by their names in the log."""
        found = {"medium": self.medium.learned(), "camera": self.camera.learned()}
        return {f"{component}/{name}": value for component, values in found.items() for name, value in values.items()}
