"""What a radiance field is."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.types import Radiance, Samples


class Field(nn.Module, ABC):
    """Density and colour of a volume."""

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        """Opposite corners of the box outside of which it holds nothing, world units; None where it has none."""
        return None

    def density(self, positions: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
        """Density alone, per world unit, in single precision; it does not depend on the direction."""
        directions = torch.zeros_like(positions)
        directions[:, 2] = -1
        s = torch.zeros(len(positions), 1, device=positions.device)
        samples = Samples(positions[:, None], directions[:, None], s, torch.cat([s, s], dim=1), s[:, 0])
        return self(samples).density[:, 0].float()

    @abstractmethod
    def forward(self, samples: Samples) -> Radiance:
        """Density (per world unit) and colour (sRGB) at every sample."""
