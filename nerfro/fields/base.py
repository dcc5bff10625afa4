"""What a radiance field is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import nn

from nerfro.types import Radiance, Samples


class Field(nn.Module, ABC):
    """Density and colour of a volume."""

    def before_step(self, progress: float) -> None:
        """Called before a training step with the share of the run's budget that is spent, in [0, 1]."""

    @abstractmethod
    def forward(self, samples: Samples) -> Radiance:
        """Density (per world unit) and colour (sRGB) at every sample."""
