"""Media in closed form: nothing at all, and the classical gradient-index lenses."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.media.base import Medium
from nerfro.registry import register


@register("medium", "vacuum")
class Vacuum(Medium):
    """Nothing: n = 1 everywhere, every ray is straight."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.zeros(2, 3), persistent=False)

    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        return torch.ones_like(positions[..., 0]), torch.zeros_like(positions)


@register("medium", "luneburg")
class Luneburg(Medium):
    """The Luneburg lens, n^2 = 2 - r^2 / R^2 for r < R: parallel rays meet in a point of its surface."""

    def __init__(self, radius: float = 1.0) -> None:
        super().__init__()
        self.radius = radius
        self.register_buffer("box", torch.tensor([[-radius] * 3, [radius] * 3]), persistent=False)

    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        squared = (positions * positions).sum(-1) / self.radius**2
        inside = squared < 1
        n = torch.where(inside, 2 - squared, 1.0).sqrt()
        return n, torch.where(inside[..., None], -positions / (self.radius**2 * n[..., None]), 0.0)


@register("medium", "maxwell_fisheye")
class MaxwellFisheye(Medium):
    """Maxwell's fish-eye, n = index / (1 + r^2 / scale^2) inside a box: rays are circles."""

    def __init__(self, index: float = 2.0, scale: float = 1.0, half_side: float = 2.0) -> None:
        super().__init__()
        self.index, self.scale = index, scale
        self.register_buffer("box", torch.tensor([[-half_side] * 3, [half_side] * 3]), persistent=False)

    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        inside = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n = self.index / (1 + (positions * positions).sum(-1) / self.scale**2)
        gradient = -2 * positions * (n * n)[..., None] / (self.index * self.scale**2)
        return torch.where(inside, n, 1.0), torch.where(inside[..., None], gradient, 0.0)


@register("medium", "fibre")
class Fibre(Medium):
    """A gradient-index fibre along z, n^2 = index^2 (1 - (strength rho)^2) inside a box: rays swing like pendulums."""

    def __init__(self, index: float = 1.5, strength: float = 0.5, radius: float = 1.0, length: float = 20.0) -> None:
        super().__init__()
        self.index, self.strength = index, strength
        self.register_buffer("box", torch.tensor([[-radius, -radius, 0.0], [radius, radius, length]]), persistent=False)

    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        inside = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        across = positions * positions.new_tensor([1.0, 1.0, 0.0])
        squared = (across * across).sum(-1)
        n = self.index * (1 - self.strength**2 * squared).clamp(min=1e-6).sqrt()
        gradient = -((self.index * self.strength) ** 2) * across / n[..., None]
        return torch.where(inside, n, 1.0), torch.where(inside[..., None], gradient, 0.0)
