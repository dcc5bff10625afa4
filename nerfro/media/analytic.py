"""Media in closed form: vacuum, and a classical gradient-index lens."""

from __future__ import annotations

import torch

from nerfro.allowed import Positive
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.registry import register


@register("medium", "vacuum")
class Vacuum(Medium):
    """Vacuum: n = 1 everywhere, and every ray is straight."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.zeros(2, 3), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        return torch.ones_like(positions[..., 0]), torch.zeros_like(positions)


@register("medium", "luneburg")
class Luneburg(Medium):
    """The Luneburg lens, n^2 = 2 - r^2 / R^2 for r < R, which focuses parallel rays on a point of its surface.

    Args:
        radius: R, world units.
    """

    def __init__(self, radius: Positive = 1.0) -> None:
        super().__init__()
        self.radius = radius
        self.register_buffer("box", torch.tensor([[-radius] * 3, [radius] * 3]), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        squared = (positions * positions).sum(-1) / self.radius**2
        inside = squared < 1
        n = torch.where(inside, 2 - squared, 1.0).sqrt()
        return n, torch.where(inside[..., None], -positions / (self.radius**2 * n[..., None]), 0.0)
