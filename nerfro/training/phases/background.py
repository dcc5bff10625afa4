"""Pretraining of the background from rays that miss the object."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.allowed import Count, Natural, Share
from nerfro.fields.base import Field
from nerfro.registry import register
from nerfro.rendering import Renderer
from nerfro.training.phases.base import Phase, Run
from nerfro.types import Exits

# Fraction of all pixels that is drawn in a step, and largest number, which bounds the memory.
_SHARE, _MOST_PIXELS = 0.01, 2**16
# The phase ends if fewer of the drawn pixels miss the object.
_MIN_PIXELS = 64
# Factor of the learning rate of the background in the first and in the last step.
_RATES = 25.0, 1.0


@register("phase", "background")
class Background(Phase):
    """Pretrain the background from pixels whose rays miss the boxes of content and object.

    Such pixels need one evaluation of the background and no tracing. With a known background, the first gradients of
    the field depend on the object. A volume that covers all of space has no such pixels, and skips the phase.

    Args:
        steps: number of steps; 0 for no pretraining.
        time_share: largest fraction of `trainer.max_time`, so that short runs train the scene, too.
        num_pixels: number of pixels that are drawn in a step; None for 1 % of all pixels, so that 600 steps draw each
            pixel several times, but at most 65536.
        learn: patterns of the names of the learned parameters. Exposures are learned as well, because a background that
            averages photographs of different exposures would slow them down.
    """

    def __init__(
        self,
        steps: Natural = 600,
        time_share: Share = 0.2,
        num_pixels: Count | None = None,
        learn: list[str] = ["background.*", "cameras.*"],  # noqa: B006 (the registry reads and copies it)
    ) -> None:
        self.steps, self.time_share, self.num_pixels, self.learn = steps, time_share, num_pixels, learn

    def steps_before(self, training_step: int) -> int:
        return self.steps

    def step(self, run: Run, number: int, state: dict[str, Any]) -> bool:
        scene, box = run.renderer.scene, occupied_box(run.renderer)
        of_background, learned = run.parameters(["background.*"]), run.parameters(self.learn)
        if box is None or not of_background:
            return False
        num_pixels = self.num_pixels or min(int(_SHARE * run.batches.num_pixels), _MOST_PIXELS)
        rays, view, rgb = run.batches.missing(box, num_pixels, number, scene.camera)
        progress = max(number / self.steps, run.spent / self.time_share)
        if len(rays) < _MIN_PIXELS or progress >= 1:
            return False
        first, last = _RATES
        for group in run.optimizer.param_groups:
            if any(parameter is own for parameter in group["params"] for own in of_background):
                group["lr"] = group["initial_lr"] * first * (last / first) ** progress
        radiance = scene.boundary(Exits.unbent(rays))
        compared = scene.colour_space.prediction_and_target(radiance, rgb, scene.camera.gains(view))
        run.descend(torch.nn.functional.mse_loss(*compared), learned)
        return True


def occupied_box(renderer: Renderer) -> Float[Tensor, "2 3"] | None:
    """Return the corners of the box around field and object; None if the field covers all of space."""
    field = renderer.scene.fields[0]
    assert isinstance(field, Field)
    if field.bounds is None:
        return None
    boxes = [field.bounds.to(renderer.scene.device)]
    if renderer.path_sampler.needs_medium:
        boxes.append(renderer.scene.medium.content_box.to(renderer.scene.device))
    low, high = torch.stack(boxes, 1)
    return torch.stack([low.amin(0), high.amax(0)])
