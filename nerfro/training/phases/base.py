"""The base class of phases."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.optimizers.config import matches, require_matches
from nerfro.rendering import RayTracer, Renderer
from nerfro.training.pixel_batches import PixelBatches


@dataclass(frozen=True)
class TrainingRun:
    """Model, data and optimizer of a training.

    Attributes:
        renderer: the model.
        batches: pixels of the training views.
        tracer: traces the rays through pixels; `tracer.trace(batches.draw(number))` is the batch of a training step.
        views: training views.
        optimizer: optimizer of the training, with moments that all phases share.
        spent: spent fraction of `trainer.max_time` or `trainer.max_steps`.
    """

    renderer: Renderer
    batches: PixelBatches
    tracer: RayTracer
    views: Views
    optimizer: torch.optim.Optimizer
    spent: float

    def parameters(self, patterns: Sequence[str]) -> list[nn.Parameter]:
        """Return the learned parameters whose names match a pattern, see `Scene.parameters_by_name`.

        Raises:
            NerfroError: a pattern matches no parameter.
        """
        learned = {name: own for name, own in self.renderer.parameters_by_name().items() if own.requires_grad}
        require_matches("the patterns of a phase", patterns, learned)
        return [own for name, own in learned.items() if matches(name, patterns)]

    def descend(self, loss: Float[Tensor, ""], parameters: Sequence[nn.Parameter]) -> None:
        """Take a step of the optimizer with some parameters.

        Args:
            loss: loss of the step. All processes need the same loss, because gradients are not averaged.
            parameters: parameters that the step changes.

        Raises:
            NerfroError: there is no parameter.
        """
        if not parameters:
            raise NerfroError("a step of a phase changes no parameter, because its patterns match no learned one")
        # backward() would wait for gradients of other processes.
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        self.optimizer.zero_grad()  # the gradients of the last training step are still there
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.optimizer.zero_grad()


class Phase(ABC):
    """A part of a training with own steps, before the first training step or between training steps.

    Phases begin in the order of the configuration. The parameters of the constructor are the settings
    `phase.NAME.SETTING`. The schedule counts the steps, and a resumed run continues with the next one.
    """

    def begin(self, run: TrainingRun) -> dict[str, Any]:
        """Prepare before the first training step.

        Returns:
            State for `step`: tensors, numbers, texts, lists and dictionaries. Checkpoints contain the state.
        """
        return {}

    @abstractmethod
    def steps_before(self, training_step: int) -> int:
        """Return the total number of steps of this phase before a training step.

        Args:
            training_step: number of the training step, from 0 on. For one step before every tenth training step, return
                `training_step // 10`.
        """

    @abstractmethod
    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        """Take a step.

        Args:
            run: model, data and optimizer; the step changes the model.
            number: number of the step, from 0 on; random numbers depend on this number.
            state: result of `begin`.

        Returns:
            True to continue with the next step later, False to end the phase.
        """
