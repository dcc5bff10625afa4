"""Pretraining of the background from rays that miss the object."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nerfro.fields.base import Field
from nerfro.progress import track
from nerfro.rendering import Renderer
from nerfro.training.callbacks import StopOnSignal
from nerfro.training.module import TrainingModule, training_progress
from nerfro.training.ray_batches import RayBatches
from nerfro.types import Exits

# Number of pixels that are drawn in a step, and largest fraction of all pixels. Pixels of the object are not used.
_NUM_PIXELS, _SHARE = 16384, 0.01
# Pretraining ends if fewer of the drawn pixels miss the object.
_MIN_PIXELS = 64
# Largest fraction of `trainer.max_time` that pretraining takes, so that short runs train the scene, too.
_TIME_SHARE = 0.2
# Factor of the learning rate of the background in the first and in the last step.
_RATES = 25.0, 1.0


class BackgroundPretraining(Callback):
    """Pretrain the background for some steps with rays that miss the boxes of content and object.

    Such pixels need one evaluation of the background and no tracing. With a known background, the first gradients of
    the field depend on the object. The optimizer of the run takes the steps, so that its moments are initialized, too.

    Pretraining ends early after a fifth of `trainer.max_time`.

    Args:
        num_steps: number of steps. If `StopOnSignal` ends pretraining, a resumed run takes the remaining steps.
    """

    def __init__(self, num_steps: int) -> None:
        self._num_steps, self._num_done = num_steps, 0

    def state_dict(self) -> dict[str, Any]:
        return {"num_done": self._num_done}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._num_done = state_dict["num_done"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        scene = pl_module.scene
        learning = [parameter for parameter in scene.boundary.parameters() if parameter.requires_grad]
        box = occupied_box(pl_module.renderer)
        if trainer.global_step > 0 or not learning or box is None:
            return
        # Gains learn, too, because a background that averages photographs of different exposures would slow them down.
        learning += [parameter for parameter in scene.camera.parameters() if parameter.requires_grad]
        optimizer = trainer.optimizers[0]
        groups = [group for group in optimizer.param_groups if any(own is learning[0] for own in group["params"])]
        first, last = _RATES
        batches: RayBatches = trainer.datamodule.batches  # type: ignore[attr-defined]
        num_pixels = min(_NUM_PIXELS, int(_SHARE * batches.num_pixels))
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        interruptions = [callback for callback in callbacks if isinstance(callback, StopOnSignal)]
        for step in track("boundary", range(self._num_done, self._num_steps)):
            if any(interruption.stop(trainer) for interruption in interruptions):
                break
            rays, view, rgb = batches.missing(box, num_pixels, step, scene.camera)
            progress = max(step / self._num_steps, training_progress(trainer) / _TIME_SHARE)
            if len(rays) < _MIN_PIXELS or progress >= 1:
                break
            for group in groups:
                group["lr"] = group["initial_lr"] * first * (last / first) ** progress
            radiance = scene.boundary(Exits.unbent(rays))
            compared = scene.colour_space.prediction_and_target(radiance, rgb, scene.camera.gains(view))
            loss = torch.nn.functional.mse_loss(*compared)
            # backward() would wait for gradients of other processes.
            gradients = torch.autograd.grad(loss, learning, allow_unused=True)
            for parameter, gradient in zip(learning, gradients, strict=True):
                parameter.grad = gradient
            optimizer.step()
            self._num_done = step + 1
        optimizer.zero_grad()


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
