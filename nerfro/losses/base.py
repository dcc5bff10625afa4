"""Base class of losses, and the schedule of their weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.types import Batch, Rendering
from nerfro.data.component import Component
from nerfro.registry.allowed import Natural, NotNegative
from nerfro.rendering import Scene


class Loss(Component, nn.Module, ABC):
    """Term of the training objective.

    Every loss has the settings `loss.NAME.weight`, `start` and `ramp`. The registry sets these attributes after
    construction, and subclasses override the defaults as class attributes.

    Attributes:
        weight: final weight.
        start: number of optimizer steps during which the weight is zero.
        ramp: number of steps after `start` during which the weight grows linearly.
    """

    SETTINGS: ClassVar[tuple[str, ...]] = ("weight", "start", "ramp")
    weight: NotNegative = 1.0
    start: Natural = 0
    ramp: Natural = 0

    def weight_at(self, step: int) -> float:
        """Return the weight at an optimizer step; the first step is 0."""
        if step < self.start:
            return 0.0
        return self.weight * min(1.0, (step - self.start + 1) / (self.ramp + 1))

    @abstractmethod
    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        """Compute the unweighted loss, averaged over the pixels of the batch.

        Args:
            renderings: one rendering for each sampling level, the finest last.
            batch: training pixels and rays.
            scene: medium, fields, background and cameras.
        """
