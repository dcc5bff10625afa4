"""Steps of the training cameras between training steps, for `camera=refined`."""

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
from nerfro.capture.outlines import align_to_masks
from nerfro.data.base import Views
from nerfro.geometry.interpolation import misses
from nerfro.rays import Rays
from nerfro.rendering import Renderer
from nerfro.subdivision import pixel_rays
from nerfro.training.background_pretraining import occupied_box
from nerfro.training.data_module import RayDataModule
from nerfro.training.module import TrainingModule
from nerfro.training.ray_batches import RayBatches

# First and least distance of finite differences in pixels, and its factor from one step to the next.
_FIRST_DIFFERENCE, _LEAST_DIFFERENCE, _DECAY = 2.0, 0.5, 0.85
# Number of full steps. The fraction of later steps decreases, so that errors of single steps average out.
_FULL_STEPS = 10
# Scale of the robust error (sRGB) per pixel of difference, and maximum motion of a camera in pixels.
_ERROR_SCALE, _MAX_PIXELS = 0.5, 1.0
# Candidates that are drawn for each pixel; the candidates with the most contrast are used.
_NUM_CANDIDATES = 6


class CameraSteps(Callback):
    """Align the training cameras by background and outlines before training, and refine them at some steps.

    The scene is fixed during these steps.

    Args:
        views: training views.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._priors: dict[str, PriorInformation] = {}  # by source
        self._aligned = False  # a run that resumes at step 0 does not repeat the alignment
        self._num_done = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        scene, box = pl_module.scene, occupied_box(pl_module.renderer)
        camera = scene.camera
        if trainer.global_step > 0 or self._aligned or box is None or not isinstance(camera, RefinedCamera):
            return
        batches = cast(RayDataModule, trainer.datamodule).batches  # type: ignore[attr-defined]
        panorama = align(camera, batches.cameras, batches.photographed, lambda rays: misses(box, rays))
        known = {"panorama": panorama, "outlines": align_to_masks(camera, self._views, scene.medium, panorama)}
        self._priors = {name: prior for name, prior in known.items() if prior is not None}
        self._aligned = True

    def state_dict(self) -> dict[str, Any]:
        priors = {name: dict(vars(prior)) for name, prior in self._priors.items()}
        return {"num_done": self._num_done, "aligned": self._aligned, "priors": priors}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._num_done, self._aligned = state_dict.get("num_done", 0), state_dict["aligned"]
        self._priors = {name: PriorInformation(**prior) for name, prior in state_dict["priors"].items()}

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        assert isinstance(pl_module, TrainingModule)
        camera, step = pl_module.scene.camera, trainer.global_step
        if not isinstance(camera, RefinedCamera) or step < camera.start or (step - camera.start) % camera.every:
            return
        data = cast(RayDataModule, trainer.datamodule)  # type: ignore[attr-defined]
        data.discard_prefetched()
        before = (step - camera.start) // camera.every
        difference = max(_LEAST_DIFFERENCE, _FIRST_DIFFERENCE * _DECAY**before)
        fraction = min(1.0, _FULL_STEPS / (before + 1))
        # Errors may increase: the scene fits the current cameras, so they are at a local minimum.
        settings = Step(difference, _ERROR_SCALE * difference, _MAX_PIXELS, fraction, keep_improvements=False)
        _move(pl_module.renderer, camera, data.batches, step, settings, self._priors)
        self._num_done += 1


@torch.no_grad()
def _move(
    renderer: Renderer,
    camera: RefinedCamera,
    batches: RayBatches,
    step: int,
    settings: Step,
    priors: dict[str, PriorInformation],
) -> None:
    """Take a Gauss-Newton step of all cameras with pixels of high contrast, which are drawn for each training step.

    If the panorama has aligned the rotations, pixels of the background are not used for rotations, because the
    background was learned from the same cameras.
    """
    box = occupied_box(renderer)
    candidates = batches.of_each_view(_NUM_CANDIDATES * camera.num_pixels, step)
    past = None
    if "panorama" in priors and box is not None:
        view = candidates.flatten() // (batches.cameras.height * batches.cameras.width)
        past = misses(box, camera(pixel_rays(batches.cameras, candidates.flatten()), view)).view(candidates.shape)
    pixels = informative_pixels(candidates, camera.num_pixels, batches.photographed, batches.cameras, past)

    def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return renderer.scene.colour_space.to_display(renderer.radiance(rays), camera.gains(view))

    gauss_newton_step(camera, batches.cameras, pixels, batches.photographed, shown, settings, list(priors.values()))
