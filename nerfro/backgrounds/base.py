"""Base class of background models, which represent the background radiance, and a background of one colour."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.types import Exits
from nerfro.data.component import Component, require_results
from nerfro.registry.allowed import NotNegative
from nerfro.registry.registration import register


class Background(Component, nn.Module, ABC):
    """Background radiance, C'(d) (paper, Eqn. 5): radiance that arrives from outside of the volume.

    It is in the colour space of the model: linear, or sRGB with `model.colour=srgb`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        contract = "radiance [..., 3] in the shape of exits.directions"
        require_results(cls, Tensor, contract, lambda radiance, exits: radiance.shape == exits.directions.shape)

    @abstractmethod
    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        """Evaluate the background radiance.

        Args:
            exits: last segments of paths. A background at infinity depends only on the directions.

        Returns:
            Radiance of each exit, not negative and without upper bound.
        """

    @property
    def face_resolution(self) -> int:
        """Number of samples along 90 degrees with which exports represent the background."""
        return 256

    @property
    def detail(self) -> float:
        """Angle in degrees of the finest detail that gradient descent learns."""
        return 0.35


@register("background", "constant")
class ConstantBackground(Background):
    """Represent the background by one radiance in all directions, black by default as in NeRF and mip-NeRF.

    Args:
        rgb: radiance of the three channels in the colour space of the model.
    """

    rgb: Float[Tensor, "3"]

    def __init__(self, rgb: list[NotNegative] = (0.0, 0.0, 0.0)) -> None:  # type: ignore[assignment]
        super().__init__()
        if len(rgb) != 3:
            raise NerfroError(f"background=constant: rgb={list(rgb)} has {len(rgb)} numbers; give three")
        self.register_buffer("rgb", torch.tensor(list(rgb)), persistent=False)

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        return self.rgb.expand(exits.directions.shape)
