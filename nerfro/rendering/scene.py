"""The scene: all learned parameters of the world."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from nerfro.backgrounds.base import Background
from nerfro.camera.base import CameraModel, GivenCamera
from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.light import ColourSpace
from nerfro.fields.base import Field
from nerfro.geometry.space import Space, Unbounded
from nerfro.kernels.available import fast_bfloat16
from nerfro.media.base import Medium


class Scene(nn.Module):
    """Refractive medium, radiance fields, background and estimated cameras.

    Args:
        medium: refractive index and absorption.
        fields: radiance fields inside the volume, coarsest sampling level first, or one field for all levels.
        background: background radiance, from beyond the volume.
        camera: estimate of the training cameras; by default the cameras of the data set.
        colour_space: colour space of the radiance of fields and background.
        space: space that the fields cover.

    Raises:
        NerfroError: exposures are learned, which needs linear radiance, but the colour space is sRGB.
    """

    def __init__(
        self,
        medium: Medium,
        fields: Sequence[Field],
        background: Background,
        camera: CameraModel | None = None,
        colour_space: ColourSpace = ColourSpace.LINEAR,
        space: Space | None = None,
    ) -> None:
        super().__init__()
        self.space = Unbounded() if space is None else space
        self.camera = GivenCamera() if camera is None else camera
        self.medium, self.fields, self.background = medium, nn.ModuleList(fields), background
        self.colour_space = colour_space
        if colour_space is ColourSpace.SRGB and self.camera.exposure is not None:
            raise NerfroError("camera.exposure and camera.appearance need linear radiance; take model.colour=linear")
        self.register_buffer("_on_device", torch.empty(0), persistent=False)  # a scene may have no other tensor

    def __repr__(self) -> str:
        fields = ", ".join(type(field).__name__ for field in self.fields)
        num_parameters = sum(parameter.numel() for parameter in self.parameters())
        return (
            f"Scene(medium={self.medium}, fields=[{fields}], background={type(self.background).__name__}, "
            f"camera={type(self.camera).__name__}, {self.colour_space.value}, {num_parameters:,} parameters)"
        )

    def begin(self, cameras: Cameras) -> None:
        """Prepare cameras and fields for training on photographs of these cameras of the data set."""
        self.camera.begin(cameras)
        for field in self.fields:
            field.begin(cameras)  # type: ignore[operator]

    @property
    def device(self) -> torch.device:
        """Device of all parameters and buffers."""
        on_device: torch.Tensor = self._on_device  # type: ignore[assignment]
        return on_device.device

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        """Return the parameters that gradient descent learns, by name.

        The settings of the optimizer (`optimizer.groups`) and the log use these names. All values that depend on the
        parameters are computed when they are needed, so changed parameters take effect at once.

        Returns:
            `fields.*` and `background.*` (weights by their attributes), `bodies.NAME.material.ior` and
            `bodies.NAME.material.absorption` (see `Material`), `medium.*` (parameters of media without bodies),
            `cameras.exposure` (with `cameras.exposure.appearance.*`), and further parameters of cameras.
        """
        parts = {"fields": self.fields, "background": self.background}
        own = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.named_parameters()}
        return own | self.medium.parameters_by_name() | self.camera.parameters_by_name()

    def path_parameters(self) -> list[nn.Parameter]:
        """Return the parameters on which paths depend: of the cameras, and of the index and surfaces of the medium."""
        parameters = self.medium.parameters_by_name() | self.camera.parameters_by_name()
        return [
            value
            for name, value in parameters.items()
            if not name.endswith(".material.absorption") and not name.startswith("cameras.exposure")
        ]

    def measurements(self) -> dict[str, float]:
        """Return learned physical quantities, such as refractive indices, by name, for the log."""
        return self.medium.measurements() | self.camera.measurements()

    def compile_radiance(self, backend: str) -> None:
        """Compile the fields and the background in place by a backend of `torch.compile`, for any number of rays.

        Copies of the scene are not compiled.
        """
        torch.compiler.assume_constant_result(fast_bfloat16)  # the compiler cannot trace it
        for module in (*self.fields, self.background):
            module.compile(backend=backend, dynamic=True)
