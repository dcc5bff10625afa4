"""Alignment of the training cameras before training, and Gauss-Newton steps between training steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.camera.refined.gauss_newton import PriorInformation, Step, gauss_newton_step, informative_pixels
from nerfro.camera.refined.outlines import OutlineSettings, align_to_masks
from nerfro.camera.refined.panorama import PanoramaSettings, align
from nerfro.camera.refined.refined import RefinedCamera
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.rays import Rays
from nerfro.geometry.interpolation import misses
from nerfro.registry.allowed import Count, Natural, OnlyWith
from nerfro.registry.registration import register
from nerfro.samplers.subdivision import pixel_rays
from nerfro.training.phases.background import occupied_box
from nerfro.training.phases.base import Phase, TrainingRun

_WITH_REFINED = OnlyWith("camera", ("refined",))


@dataclass(frozen=True)
class CameraStepSettings(AlgorithmSettings):
    """Settings of the Gauss-Newton steps between training steps (`CameraSteps`).

    Attributes:
        first_difference, min_difference: first and least distance of finite differences, in pixels.
        decay: factor of this distance from one step to the next.
        full_steps: number of full steps. The fraction of later steps decreases, so that errors of single steps average
            out.
        error_scale: scale of the robust loss (sRGB) per pixel of difference.
        max_pixels: largest motion of a camera in a step, in pixels.
        num_candidates: number of candidates that are drawn for each pixel; those with the most contrast are used.
        panorama, outlines: settings of the alignment before training.
    """

    first_difference: float = 2.0
    min_difference: float = 0.5
    decay: float = 0.85
    full_steps: int = 10
    error_scale: float = 0.5
    max_pixels: float = 1.0
    num_candidates: int = 6
    panorama: PanoramaSettings = field(default=PanoramaSettings())
    outlines: OutlineSettings = field(default=OutlineSettings())


@register("phase", "cameras")
class CameraSteps(Phase):
    """Align the training cameras of `camera=refined` before training, and refine them between training steps.

    The alignment uses background and outlines (`panorama`, `outlines`), if the data contain these.
    The steps are Gauss-Newton steps of all cameras (`gauss_newton`) with a fixed scene.

    Args:
        start: training step of the first Gauss-Newton step. Earlier, the scene is too inaccurate.
        every: number of training steps between two Gauss-Newton steps.
        num_pixels: number of pixels of each photograph in a Gauss-Newton step.

    Attributes:
        settings: tuned numbers of the steps.
    """

    settings = CameraStepSettings()

    def __init__(
        self,
        start: Annotated[Natural, _WITH_REFINED] = 50,
        every: Annotated[Count, _WITH_REFINED] = 50,
        num_pixels: Annotated[Count, _WITH_REFINED] = 300,
    ) -> None:
        self.start, self.every, self.num_pixels = start, every, num_pixels
        self.settings.use()

    def begin(self, run: TrainingRun) -> dict[str, Any]:
        """Align the cameras; returns the prior information about the cameras by source."""
        scene, box = run.renderer.scene, occupied_box(run.renderer)
        camera = scene.camera
        if box is None or not isinstance(camera, RefinedCamera):
            return {}
        batches, settings = run.batches, self.settings
        of_sky = lambda rays: misses(box, rays)  # noqa: E731
        panorama = align(camera, batches.cameras, batches.photographed, of_sky, settings.panorama)
        outlines = align_to_masks(camera, run.views, scene.medium, panorama, settings.outlines)
        priors = {"panorama": panorama, "outlines": outlines}
        return {source: dict(vars(prior)) for source, prior in priors.items() if prior is not None}

    def steps_before(self, training_step: int) -> int:
        return 0 if training_step < self.start else 1 + (training_step - self.start) // self.every

    @torch.no_grad()
    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        """Take a Gauss-Newton step of all cameras with newly drawn pixels of high contrast.

        If the panorama has aligned the rotations, pixels of the background are excluded, because the background was
        learned from the same cameras.
        """
        renderer, batches, settings = run.renderer, run.batches, self.settings
        camera, box = renderer.scene.camera, occupied_box(renderer)
        if not isinstance(camera, RefinedCamera):
            return False
        candidates = batches.of_each_view(settings.num_candidates * self.num_pixels, self.start + number * self.every)
        past = None
        if "panorama" in state and box is not None:
            drawn = candidates.flatten()
            rays = camera(pixel_rays(batches.cameras, drawn), batches.cameras.view_of(drawn))
            past = misses(box, rays).view(candidates.shape)
        pixels = informative_pixels(candidates, self.num_pixels, batches.photographed, batches.cameras, past)

        def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
            return renderer.scene.colour_space.to_display(renderer.radiance(rays), camera.gains(view, rays))

        difference = max(settings.min_difference, settings.first_difference * settings.decay**number)
        fraction = min(1.0, settings.full_steps / (number + 1))
        # The step is accepted even if the error rises, because the scene was trained with the current cameras, which
        # are therefore a local minimum.
        step = Step(difference, settings.error_scale * difference, settings.max_pixels, fraction)
        priors = [PriorInformation(**prior) for prior in state.values()]
        gauss_newton_step(camera, batches.cameras, pixels, batches.photographed, shown, step, priors)
        return True
