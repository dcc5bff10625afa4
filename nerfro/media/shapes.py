"""A ball with a signed distance in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.media.base import Vectors
from nerfro.media.material import Learns
from nerfro.media.solid import Solid
from nerfro.registry.allowed import NotNegative, Positive
from nerfro.registry.registration import register

# Air around the ball as a share of its radius, because half of the shell lies outside the surface.
_MARGIN = 0.05


@register("medium", "ball")
class Ball(Solid):
    """A ball around the origin.

    Args:
        radius: radius of the ball, world units.
        ior: refractive index.
        shell: half width of the smooth interface for `sampler/path=eikonal`, world units.
        absorption: absorption coefficients of red, green and blue, or one number for all, per world unit.
        learn_absorption: learn the absorption.
        abbe: Abbe number, for dispersion.
    """

    def __init__(
        self,
        radius: Positive = 0.8,
        ior: Positive = 1.5,
        shell: Positive = 0.002,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: Learns = False,
        abbe: Sequence[Positive] = (),
    ) -> None:
        super().__init__([ior], shell, absorption, learn_absorption, abbe)
        self.scale_absorption([torch.tensor([[-radius] * 3, [radius] * 3])])
        self.radius = radius
        side = radius * (1 + _MARGIN) + shell
        self.register_buffer("box", torch.tensor([[-side] * 3, [side] * 3]), persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Return |x| - R and x / |x|."""
        distance = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
        return distance - self.radius, functional.normalize(positions, dim=-1)[..., None, :]
