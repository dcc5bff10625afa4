"""Template: a background of your own in one file. Use it with `background=gradient_sky`."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.parts import Background, Exits, NerfroError, register


@register("background", "gradient_sky")
class GradientSky(Background):
    """Blend two learned radiances by the height of the direction.

    Args:
        up: axis that points up, 0, 1 or 2.
    """

    def __init__(self, up: int = 2) -> None:
        super().__init__()
        if up not in (0, 1, 2):
            raise NerfroError(f"gradient_sky: up={up} is no axis; choose 0, 1 or 2")
        self.up = up
        # Ground and zenith, before the exponential. Radiance above 1 is clipped and has no gradient.
        self.raw = nn.Parameter(torch.full((2, 3), -1.5))

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        height = 0.5 * (1 + exits.directions[..., self.up, None])
        ground, zenith = torch.exp(self.raw)
        return ground + height * (zenith - ground)
