"""What a boundary is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerfro.types import Exits


class Boundary(nn.Module, ABC):
    """Radiance that arrives from beyond the volume, C'(d) of the paper's Eqn. volrendBd."""

    @abstractmethod
    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        """Linear radiance, not negative and unbounded above; a sky needs the exits' directions alone."""
