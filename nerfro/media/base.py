"""What a medium is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class Medium(nn.Module, ABC):
    """Refractive index in space; outside its box n = 1 and grad n = 0.

    Attributes:
        box: lower and upper corner, world units.
    """

    box: Float[Tensor, "2 3"]

    @abstractmethod
    def forward(
        self, positions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Refractive index and its gradient (per world unit)."""
