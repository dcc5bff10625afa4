"""What a radiance field is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerfro.types import Radiance, Samples


class Field(nn.Module, ABC):
    """Density and colour of a volume."""

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        """Opposite corners of the box outside of which it holds nothing, world units; None where it has none."""
        return None

    @abstractmethod
    def forward(self, samples: Samples) -> Radiance:
        """Density (per world unit) and colour (sRGB) at every sample."""
