"""Total variation of the boundary."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.allowed import Count, Natural, NotNegative, Range
from nerfro.losses.base import Loss, Model
from nerfro.registry import register
from nerfro.types import Batch, Exits, Rendering


@register("loss", "total_variation")
class TotalVariation(Loss):
    """Absolute difference of the boundary's colour between directions `angle` apart, all over the sphere.

    Unlike `smoothness`, which squares differences, it does not prefer many small steps to one edge (Rudin, Osher and
    Fatemi, 1992), and it reaches directions in which no training ray leaves.

    Args:
        num_directions: random pairs for each step.
        angle: between the two directions of a pair, degrees; about a texel of the boundary.
    """

    def __init__(
        self,
        weight: NotNegative = 1e-3,
        start: Natural = 0,
        ramp: Natural = 0,
        num_directions: Count = 1024,
        angle: Annotated[float, Range(more_than=0, less_than=90)] = 0.7,
    ) -> None:
        super().__init__(weight, start, ramp)
        self.num_directions, self.angle = num_directions, angle

    def forward(self, renderings: list[Rendering], batch: Batch, model: Model) -> Float[Tensor, ""]:
        first, second = direction_pairs(self.num_directions, math.radians(self.angle), batch.rgb.device)
        rgb = model.encode(model.boundary(Exits(torch.cat([first, second]))))
        return (rgb[self.num_directions :] - rgb[: self.num_directions]).abs().mean()


def direction_pairs(
    num: int, angle: float, device: torch.device | str
) -> tuple[Float[Tensor, "num 3"], Float[Tensor, "num 3"]]:
    """Uniformly random unit directions, and for each another one `angle` radians from it, anywhere around."""
    first = normalize(torch.randn(num, 3, device=device), dim=-1)
    tangent = normalize(torch.linalg.cross(first, torch.randn(num, 3, device=device)), dim=-1)
    return first, math.cos(angle) * first + math.sin(angle) * tangent
