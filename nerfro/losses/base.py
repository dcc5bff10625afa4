"""Base class of losses, the schedule of their weights, and the training objective: their weighted sum."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
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


@dataclass(frozen=True)
class ObjectiveValue:
    """Value of the objective in one step.

    Attributes:
        total: weighted sum of the losses.
        weights: weight of each loss in this step.
        losses: values of the losses with a positive weight.
        squared_error: mean squared error of the pixels (sRGB) at the finest sampling level.
    """

    total: Float[Tensor, ""]
    weights: dict[str, float]
    losses: dict[str, Float[Tensor, ""]]
    squared_error: Float[Tensor, ""]


class Objective(nn.Module):
    """Weighted sum of losses by name; see `Loss` for the schedule of the weights."""

    def __init__(self, losses: Mapping[str, Loss]) -> None:
        super().__init__()
        self.losses = nn.ModuleDict(dict(losses))

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene, step: int) -> ObjectiveValue:
        """Evaluate the losses whose weight is positive in a step.

        Args:
            renderings: one rendering of the batch for each sampling level, the finest last.
            batch: training pixels and rays.
            scene: medium, fields, background and cameras.
            step: number of the optimizer step, from 0.

        Raises:
            NerfroError: no loss has a positive weight, or a loss is not a scalar.
        """
        weights: dict[str, float] = {name: loss.weight_at(step) for name, loss in self.losses.items()}  # type: ignore[operator]
        values = {name: self.losses[name](renderings, batch, scene) for name, weight in weights.items() if weight > 0}
        total = torch.zeros((), device=batch.rgb.device)
        for name, value in values.items():
            if value.ndim > 0:
                raise NerfroError(f"loss={name} returned shape {list(value.shape)}; a loss is a scalar")
            total = total + weights[name] * value
        if not total.requires_grad:
            raise NerfroError(
                f"no loss has a positive weight in step {step}, so there is nothing to learn; raise a weight "
                "(loss.photometric.weight=1), or start a loss earlier"
            )
        shown = scene.colour_space.to_display(batch.per_pixel(renderings[-1].radiance.detach()))
        return ObjectiveValue(total, weights, values, (shown - batch.rgb.clamp(0, 1)).square().mean())
