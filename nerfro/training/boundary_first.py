"""What lies beyond the object, learned before the first step: nothing stands before it where rays miss the object."""

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
from nerfro.training.module import TrainingModule
from nerfro.training.ray_batches import RayBatches
from nerfro.types import Exits

# Pixels that are drawn for a step, at most this share of all; those that see the object are left out.
_NUM_PIXELS, _SHARE = 16384, 0.01
# A step with fewer pixels beside the object is no step.
_FEWEST = 64
# Of the boundary's learning rate, in the first and in the last of these steps.
_RATES = 25.0, 1.0


class BoundaryFirst(Callback):
    """Lets the boundary learn, for some steps, from rays that miss the boxes of content and object.

    Their pixels cost one look-up each and no tracing, and a sky that is known lets the first gradients of the field be
    about the object. The run's own optimiser does it, so that the boundary's moments are warm as well.

    Args:
        num_steps: number of steps.
        interruption: ends these steps as well; a resumed run takes the others.
    """

    def __init__(self, num_steps: int, interruption: StopOnSignal) -> None:
        self._num_steps, self._interruption = num_steps, interruption
        self._num_done = 0

    def state_dict(self) -> dict[str, Any]:
        return {"num_done": self._num_done}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._num_done = state_dict["num_done"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        scene = pl_module.scene
        learning = [parameter for parameter in scene.boundary.parameters() if parameter.requires_grad]
        box = occupied(pl_module.renderer)
        if trainer.global_step > 0 or not learning or box is None:
            return
        # The views' gains as well: a sky that is the mean of photographs of unlike brightness would hold them back.
        learning += [parameter for parameter in scene.camera.parameters() if parameter.requires_grad]
        optimizer = trainer.optimizers[0]
        group = next(group for group in optimizer.param_groups if group["name"] == "boundary")
        first, last = _RATES
        batches: RayBatches = trainer.datamodule.batches  # type: ignore[attr-defined]
        num_pixels = min(_NUM_PIXELS, int(_SHARE * batches.num_pixels))
        for step in track("boundary", range(self._num_done, self._num_steps)):
            if self._interruption.stop(trainer):
                break
            rays, view, rgb = batches.missing(box, num_pixels, step, scene.camera)
            if len(rays) < _FEWEST:
                break
            group["lr"] = group["initial_lr"] * first * (last / first) ** (step / self._num_steps)
            radiance = scene.boundary(Exits.unbent(rays))
            compared = scene.colour_space.prediction_and_target(radiance, rgb, scene.camera.gains(view))
            loss = torch.nn.functional.mse_loss(*compared)
            # Not by backward(): gradients of several processes would be waited for.
            gradients = torch.autograd.grad(loss, learning, allow_unused=True)
            for parameter, gradient in zip(learning, gradients, strict=True):
                parameter.grad = gradient
            optimizer.step()
            self._num_done = step + 1
        optimizer.zero_grad()


def occupied(renderer: Renderer) -> Float[Tensor, "2 3"] | None:
    """Corners of the box outside of which there is nothing but the boundary; None where the field fills all space."""
    field = renderer.scene.fields[0]
    assert isinstance(field, Field)
    if field.bounds is None:
        return None
    boxes = [field.bounds.to(renderer.scene.device)]
    if renderer.path_sampler.needs_medium:
        boxes.append(renderer.scene.medium.content_box.to(renderer.scene.device))
    low, high = torch.stack(boxes, 1)
    return torch.stack([low.amin(0), high.amax(0)])
