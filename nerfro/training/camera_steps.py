"""Steps of the cameras between those of the scene, where `camera=refined`."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float, Int
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nerfro.camera.gauss_newton import Step, improve, telling
from nerfro.camera.refined import RefinedCamera
from nerfro.models.base import NerfModel
from nerfro.rays import Rays
from nerfro.training.data_module import RayDataModule
from nerfro.training.ray_batches import RayBatches

# Pixels over which differences are taken, at first and at least, and their factor from one step to the next.
_FIRST_REACH, _LEAST_REACH, _SHRINKING = 2.0, 0.5, 0.85
# Scale of the robust error (sRGB) for each pixel of reach; and pixels that a camera is moved at most.
_SCALE, _LONGEST = 0.5, 1.0
# Pixels that are drawn for each that is looked at, so that there are enough with contrast.
_DRAWN = 3


class CameraSteps(Callback):
    """Moves the training cameras at some steps, each towards its photograph, with the scene held.

    Args:
        batches: of the run.
    """

    def __init__(self, batches: RayBatches) -> None:
        self._batches = batches

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        assert isinstance(pl_module, NerfModel)
        camera, step = pl_module.camera, trainer.global_step
        if not isinstance(camera, RefinedCamera) or step < camera.start or (step - camera.start) % camera.every:
            return
        cast(RayDataModule, trainer.datamodule).make_anew()  # type: ignore[attr-defined]
        reach = max(_LEAST_REACH, _FIRST_REACH * _SHRINKING ** ((step - camera.start) // camera.every))
        # Not asked whether errors fall: every camera has painted its own ghost, which holds it where it is.
        how = Step(reach, _SCALE * reach, _LONGEST, checked=False)
        _move(pl_module, camera, self._batches, step, how)


@torch.no_grad()
def _move(model: NerfModel, camera: RefinedCamera, batches: RayBatches, step: int, how: Step) -> None:
    """A step of all cameras by pixels with contrast, drawn anew for each training step."""
    batches = batches.to(model.device)
    candidates = batches.of_each_view(_DRAWN * camera.num_pixels, step)
    pixels = telling(candidates, camera.num_pixels, batches.photographed, batches.cameras)

    def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return model.shown(rays, camera.gains(view))

    improve(camera, batches.cameras, pixels, batches.photographed, shown, how)
