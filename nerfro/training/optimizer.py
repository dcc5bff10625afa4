"""Settings of Adam and the learning rate schedule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Optional

from nerfro.allowed import Natural, NotNegative, Positive, checked


@checked("optimizer")
@dataclass
class OptimizerConfig:
    """Adam with a log-linear learning rate and a sine warm-up (authors' code; mip-NeRF, section 4)."""

    learning_rate: Positive = 5e-4  # initial learning rate
    final_learning_rate: Positive = 5e-6  # learning rate at the end of the run
    # Initial learning rate of the background, with the same decay; None for the common rate.
    boundary_learning_rate: Optional[Positive] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    medium_learning_rate: Optional[Positive] = None  # noqa: UP045 - of refractive indices; None for the common rate
    # Initial learning rate of absorption coefficients; None for the common rate.
    absorption_learning_rate: Optional[Positive] = None  # noqa: UP045
    exposure_learning_rate: Optional[Positive] = None  # noqa: UP045 - of exposures; None for the common rate
    medium_start: Natural = 0  # step at which refractive indices begin to learn, after the scene is roughly known
    boundary_steps: Natural = 0  # steps that pretrain the background with rays that miss the content's box
    # Step at which the background resumes learning, from all rays; earlier, it would learn the colours of the content.
    boundary_start: Natural = 0
    warmup_steps: Natural = 2500  # length of the warm-up; 0 for none
    warmup_factor: NotNegative = 0.01  # factor of the learning rate at its first step
    adam_epsilon: Positive = 1e-8  # epsilon of Adam

    def rate(self, group: str) -> float:
        """Return the initial learning rate of a parameter group."""
        own: float | None = getattr(self, f"{group}_learning_rate", None)
        return self.learning_rate if own is None else own

    def start(self, group: str) -> int:
        """Return the step at which a parameter group begins to learn."""
        return getattr(self, f"{group}_start", 0)


def learning_rate_factor(step: int, progress: float, config: OptimizerConfig) -> float:
    """Return the factor of the initial learning rates: log-linear decay times the sine warm-up of mip-NeRF."""
    factor = (config.final_learning_rate / config.learning_rate) ** progress
    if config.warmup_steps > 0:
        ascent = math.sin(0.5 * math.pi * min(step / config.warmup_steps, 1.0))
        factor *= config.warmup_factor + (1.0 - config.warmup_factor) * ascent
    return factor
