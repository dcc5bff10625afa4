"""What a loss is, and its weight's schedule."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from nerfro.allowed import Natural, NotNegative, checked
from nerfro.boundaries.base import Boundary
from nerfro.types import Batch, Rendering


@runtime_checkable
class Model(Protocol):
    """What losses know of the model (`nerfro.models.base.NerfModel`)."""

    boundary: Boundary

    def encode(self, radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]: ...

    def difference(
        self, radiance: Float[Tensor, "*batch 3"], rgb: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]: ...


@checked("loss")
class Loss(nn.Module, ABC):
    """A term of the training objective, weighted by `weight` once `start` steps are done, ramped in over `ramp` steps.

    Args:
        weight: final weight.
        start: number of optimiser steps during which the weight is zero.
        ramp: number of steps after that over which it grows linearly.
    """

    def __init__(self, weight: NotNegative = 1.0, start: Natural = 0, ramp: Natural = 0) -> None:
        super().__init__()
        self.weight, self.start, self.ramp = weight, start, ramp

    def weight_at(self, step: int) -> float:
        """Weight at the given optimiser step (0 is the first)."""
        if step < self.start:
            return 0.0
        return self.weight * min(1.0, (step - self.start + 1) / (self.ramp + 1))

    @abstractmethod
    def forward(self, renderings: list[Rendering], batch: Batch, model: Model) -> Float[Tensor, ""]:
        """Unweighted value, averaged over the batch."""
