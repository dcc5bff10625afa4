"""What a boundary is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class Boundary(nn.Module, ABC):
    """Radiance that arrives from beyond the volume, C'(d) of the paper's Eqn. volrendBd."""

    @abstractmethod
    def forward(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Colour (sRGB) in the given unit directions, in which light is looked for (pointing away from the volume)."""
