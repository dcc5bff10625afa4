"""Template: a body of your own with a sharp surface in one file. Use it with `medium=rounded_cube`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.allowed import NotNegative, Positive
from nerfro.media.base import Vectors
from nerfro.media.solid import Solid
from nerfro.registry import register


@register("medium", "rounded_cube")
class RoundedCube(Solid):
    """Cube around the origin with rounded edges.

    Args:
        half_side: half of the side, world units.
        rounding: radius of the edges, world units.
        ior, shell, absorption, learn_absorption: see `Solid`.
    """

    def __init__(
        self,
        half_side: Positive = 0.6,
        rounding: Positive = 0.1,
        ior: Positive = 1.5,
        shell: Positive = 0.002,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
    ) -> None:
        super().__init__([ior], shell, absorption, learn_absorption)
        self.half_side, self.rounding = half_side, rounding
        side = 1.05 * half_side + shell  # the box contains the surface and some air
        self.register_buffer("box", torch.tensor([[-side] * 3, [side] * 3]), persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Return the distance to the cube, negative inside, and its gradient, a unit vector; K = 1 body."""
        offsets = positions.abs() - (self.half_side - self.rounding)
        outside = offsets.clamp(min=0)
        inside = offsets.amax(-1, keepdim=True).clamp(max=0)
        distance = torch.linalg.vector_norm(outside, dim=-1, keepdim=True) + inside - self.rounding
        nearest_side = functional.one_hot(offsets.argmax(-1), 3).to(positions)
        direction = torch.where(inside < 0, nearest_side, functional.normalize(outside, dim=-1))
        return distance, (direction * positions.sign())[..., None, :]
