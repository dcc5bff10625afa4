"""A background of one colour."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.errors import NerfroError
from nerfro.core.types import Exits
from nerfro.registry.allowed import NotNegative
from nerfro.registry.registration import register


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
