"""Steps of the cameras between those of the scene, where `camera=refined`."""

from __future__ import annotations

from typing import Any, cast

import torch
from jaxtyping import Float, Int
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nerfro.camera.gauss_newton import Step, gauss_newton_step, informative_pixels
from nerfro.camera.least_squares import PriorInformation
from nerfro.camera.panorama import align
from nerfro.camera.refined import RefinedCamera
from nerfro.data.base import Views
from nerfro.geometry.interpolation import misses
from nerfro.rays import Rays
from nerfro.rendering import Renderer
from nerfro.subdivision import pixel_rays
from nerfro.training.boundary_first import occupied
from nerfro.training.data_module import RayDataModule
from nerfro.training.module import TrainingModule
from nerfro.training.outlines import meet_masks
from nerfro.training.ray_batches import RayBatches

# Pixels over which differences are taken, at first and at least, and their factor from one step to the next.
_FIRST_REACH, _LEAST_REACH, _SHRINKING = 2.0, 0.5, 0.85
# Steps that are taken whole. Of later ones always less is: errors of single steps average out.
_WHOLE = 10
# Scale of the robust error (sRGB) for each pixel of reach; and pixels that a camera is moved at most.
_SCALE, _LONGEST = 0.5, 1.0
# Pixels that are drawn for each that is looked at, so that there are enough with contrast.
_DRAWN = 6


class CameraSteps(Callback):
    """Moves the training cameras by sky and outlines before training, and at some steps, with the scene held.

    Args:
        views: training views.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._priors: dict[str, PriorInformation] = {}  # by source
        self._aligned = False  # by sky and outlines; a run that resumes at step 0 does not repeat the alignment

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        scene, box = pl_module.scene, occupied(pl_module.renderer)
        camera = scene.camera
        if trainer.global_step > 0 or self._aligned or box is None or not isinstance(camera, RefinedCamera):
            return
        batches = cast(RayDataModule, trainer.datamodule).batches  # type: ignore[attr-defined]
        panorama = align(camera, batches.cameras, batches.photographed, lambda rays: misses(box, rays))
        known = {"panorama": panorama, "outlines": meet_masks(camera, self._views, scene.medium, panorama)}
        self._priors = {name: prior for name, prior in known.items() if prior is not None}
        self._aligned = True

    def state_dict(self) -> dict[str, Any]:
        return {"aligned": self._aligned, "priors": {name: dict(vars(prior)) for name, prior in self._priors.items()}}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._aligned = state_dict["aligned"]
        self._priors = {name: PriorInformation(**prior) for name, prior in state_dict["priors"].items()}

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        assert isinstance(pl_module, TrainingModule)
        camera, step = pl_module.scene.camera, trainer.global_step
        if not isinstance(camera, RefinedCamera) or step < camera.start or (step - camera.start) % camera.every:
            return
        data = cast(RayDataModule, trainer.datamodule)  # type: ignore[attr-defined]
        data.make_anew()
        before = (step - camera.start) // camera.every
        reach = max(_LEAST_REACH, _FIRST_REACH * _SHRINKING**before)
        # Not asked whether errors fall: every camera has painted its own ghost, which holds it where it is.
        how = Step(reach, _SCALE * reach, _LONGEST, fraction=min(1.0, _WHOLE / (before + 1)), keep_improvements=False)
        _move(pl_module.renderer, camera, data.batches, step, how, self._priors)


@torch.no_grad()
def _move(
    renderer: Renderer,
    camera: RefinedCamera,
    batches: RayBatches,
    step: int,
    how: Step,
    priors: dict[str, PriorInformation],
) -> None:
    """A step of all cameras by pixels with contrast, drawn anew for each training step.

    Where a panorama tells how they are turned, what is seen past the object does not: the sky has learned it from them.
    """
    box = occupied(renderer)
    candidates = batches.of_each_view(_DRAWN * camera.num_pixels, step)
    past = None
    if "panorama" in priors and box is not None:
        view = candidates.flatten() // (batches.cameras.height * batches.cameras.width)
        past = misses(box, camera(pixel_rays(batches.cameras, candidates.flatten()), view)).view(candidates.shape)
    pixels = informative_pixels(candidates, camera.num_pixels, batches.photographed, batches.cameras, past)

    def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return renderer.scene.colour_space.to_display(renderer.radiance(rays), camera.gains(view))

    gauss_newton_step(camera, batches.cameras, pixels, batches.photographed, shown, how, list(priors.values()))
