"""The medium without an object."""

from __future__ import annotations

import torch

from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.registry.registration import register


@register("medium", "vacuum")
class Vacuum(Medium):
    """Vacuum: n = 1 everywhere, and every ray is straight."""

    is_vacuum = True

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.zeros(2, 3), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        return torch.ones_like(positions[..., 0]), torch.zeros_like(positions)
