"""Template: a phase of your own in one file. Use it with `+phase.extra_steps.every=10`."""

from __future__ import annotations

from typing import Any

from nerfro.parts import Count, Phase, TrainingRun, register

_OTHER_PIXELS = 10**6  # numbers of batches that training steps do not use


@register("phase", "extra_steps")
class ExtraSteps(Phase):
    """Learn some parameters faster: they take additional steps on batches of their own.

    Args:
        every: number of training steps between two of these steps.
        learn: patterns of the names of the learned parameters.
    """

    def __init__(self, every: Count = 10, learn: list[str] = ["background.*"]) -> None:  # noqa: B006
        self.every, self.learn = every, learn

    def steps_before(self, training_step: int) -> int:
        return training_step // self.every

    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        batch = run.tracer.trace(run.batches.for_rank(0, 1).draw(_OTHER_PIXELS + number))  # equal in all processes
        radiance = batch.per_pixel(run.renderer.render_batch(batch)[-1].radiance)
        error = run.renderer.scene.colour_space.to_srgb(radiance) - batch.rgb
        run.descend(error.square().mean(), run.parameters(self.learn))
        return True
