"""What a boundary is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerfro.types import Path


class Boundary(nn.Module, ABC):
    """Radiance that arrives from beyond the volume, C'(d) of the paper's Eqn. volrendBd."""

    @abstractmethod
    def forward(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Colour (sRGB) in the given unit directions, in which light is looked for (pointing away from the volume)."""

    def along(self, path: Path, directions: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Colour at the ends of paths that leave in `directions`; of a sky, which is far, these alone matter."""
        return self(directions)

    def after_step(self, step: int) -> None:
        """Called after a training step, with the number of optimiser steps done, for boundaries that keep a record."""
