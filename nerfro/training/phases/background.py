"""Fits of the background to pixels without content."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.backgrounds.envmap import EnvironmentMap, Observed
from nerfro.core.errors import warn
from nerfro.core.light import saturated
from nerfro.core.provenance import AlgorithmSettings
from nerfro.core.rays import Rays
from nerfro.core.types import Exits
from nerfro.fields.base import Field
from nerfro.geometry.interpolation import misses
from nerfro.kernels.available import return_freed_memory
from nerfro.registry.allowed import Count, Natural, OnlyWith, Share
from nerfro.registry.registration import register
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import DIVERGENT, divergence, main_exits, neighbour_rays, pixel_rays
from nerfro.training.phases.base import Phase, TrainingRun

_WITH_MAP, _WITH_BOX = OnlyWith("background", ("envmap",)), OnlyWith("content.space", ("box",))


@dataclass(frozen=True)
class BackgroundSettings(AlgorithmSettings):
    """Settings of the fits of the background (`BackgroundSteps`).

    Attributes:
        max_pixels: largest number of pixels of a pass beside the object, relative to the texels of the finest level.
        max_fitted_pixels: largest number of pixels of one fit, which bounds the memory.
        share: largest number of rays of a pass through the object, relative to the pixels of all training steps so far,
            which bounds the share of the time.
        max_rays: largest number of these rays, which bounds the duration of a step.
        min_background: rays through the object count if at least this fraction of their light is background.
        direct_weight: weight of a ray beside the object. A ray through the object has at most a weight of 1, because
            its direction and its radiance depend on surface, index and field.
        turns: number of turns between background and exposures in the first step.
    """

    max_pixels: int = 8
    max_fitted_pixels: int = 2**21
    share: float = 0.15
    max_rays: int = 2**19
    min_background: float = 0.7
    direct_weight: float = 10.0
    turns: int = 10


@register("phase", "background")
class BackgroundSteps(Phase):
    """Fit the environment map to pixels that show only the background, without gradient descent.

    A pass before training uses pixels whose rays miss the boxes of content and object. Such rays need no tracing. With
    a known background, the first gradients of the field depend on the object. Later passes also use rays through the
    object that cross hardly any content: the pixel minus the rendered light of the field is the background in the exit
    direction. Some directions are visible only through the object. The later passes precede the training steps `start`,
    2 `start`, 4 `start` and so on, because the field becomes more accurate.

    A step of Adam changes each texel by about the learning rate, for any number of rays. The mean of all rays, see
    `EnvironmentMap.fit`, is more accurate. Other backgrounds, and backgrounds behind a volume that covers all of space,
    skip the phase. With dispersion, no pass uses rays through the object, because each colour has its own exit
    direction.

    Args:
        steps: number of steps of a pass, which share the rows of the photographs; 0 for no pass. The exposures of the
            photographs are fitted as well.
        time_share: largest fraction of `trainer.max_time` for the pass before training, so that short runs train the
            scene, too.
        start: training step of the first pass that also uses rays through the object; None for no such pass.

    Attributes:
        settings: tuned numbers of the fits.
    """

    settings = BackgroundSettings()

    def __init__(
        self,
        steps: Annotated[Natural, _WITH_MAP, _WITH_BOX] = 10,
        time_share: Annotated[Share, _WITH_MAP, _WITH_BOX, OnlyWith("steps")] = 0.2,
        start: Annotated[Count | None, _WITH_MAP, _WITH_BOX, OnlyWith("steps")] = 100,
    ) -> None:
        self.steps, self.time_share, self.start = steps, time_share, start
        self.settings.use()

    def begin(self, run: TrainingRun) -> dict[str, Any]:
        """Return the weights of the observations of each texel in the current pass."""
        background = run.renderer.scene.background
        if not isinstance(background, EnvironmentMap) or not background.texels.requires_grad:
            return {}
        if occupied_box(run.renderer) is None:
            field = run.renderer.scene.fields[0]
            if self.steps and isinstance(field, Field) and type(field).bounds is Field.bounds:
                warn("the background is not fitted, because the field has no bounds; define its property `bounds`")
            return {}
        return {"weights": torch.zeros(background.levels.num_texels)}

    def steps_before(self, training_step: int) -> int:
        later_passes = 0 if self.start is None else (training_step // self.start).bit_length()
        return self.steps * (1 + later_passes)

    @torch.no_grad()
    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        background, box = run.renderer.scene.background, occupied_box(run.renderer)
        if not state or not isinstance(background, EnvironmentMap) or box is None:
            return False
        number_of_pass, part = divmod(number, self.steps)
        if number_of_pass == 0 and run.spent >= self.time_share:
            return True
        # A checkpoint restores the state on the CPU.
        state["weights"] = state["weights"].to(background.texels.device)
        if part == 0:
            state["weights"].zero_()
        num_pixels, settings = run.batches.num_pixels, self.settings
        most_pixels = min(num_pixels, settings.max_pixels * background.levels.sizes[-1])
        fits_per_step = math.ceil(most_pixels / (self.steps * settings.max_fitted_pixels))
        num_fits = self.steps * fits_per_step  # of the pass
        num_parts = num_fits * num_pixels // most_pixels
        for fit in range(part * fits_per_step, (part + 1) * fits_per_step):
            pixels = run.batches.rows(fit * num_parts // num_fits, num_parts)
            beside, rays, crossing = _divided(run, pixels, box)
            if number_of_pass == fit == 0 and run.renderer.scene.camera.exposure is not None:
                for turn in range(settings.turns):
                    observed_pixels = _observe_beside_object(run, beside, rays, settings.direct_weight, turn > 0)
                    background.fit(observed_pixels, torch.zeros_like(state["weights"]))
            parts = [_observe_beside_object(run, beside, rays, settings.direct_weight)]
            if number_of_pass > 0 and not run.renderer.scene.medium.disperses:
                used = crossing[:: self._spacing(run, len(crossing) * num_fits, number_of_pass)]
                chunks = used.split(run.renderer.chunk_size)
                parts += [_observe_through_object(run, chunk, settings.min_background) for chunk in chunks]
            observed = Observed.joined(parts)
            del beside, rays, parts
            return_freed_memory()  # a fit has tensors of other sizes than rays and training steps
            background.fit(observed, state["weights"])
        return True

    def _spacing(self, run: TrainingRun, num_crossing: int, number_of_pass: int) -> int:
        """Return the spacing of the used pixels among `num_crossing` pixels of a pass through the object."""
        assert self.start is not None
        num_trained = self.start * 2 ** (number_of_pass - 1) * run.batches.batch_size
        return max(1, math.ceil(num_crossing / min(self.settings.share * num_trained, self.settings.max_rays)))


def _divided(
    run: TrainingRun, pixels: Int[Tensor, "Q"], box: Float[Tensor, "2 3"]
) -> tuple[Int[Tensor, " beside"], Rays, Int[Tensor, " crossing"]]:
    """Return the pixels whose rays miss a box, with their rays, and the other pixels."""
    beside, rays, crossing = [], [], []
    for chunk in pixels.split(2**18):
        of_chunk = _rays(run, chunk)
        beside_box = misses(box, of_chunk)
        beside.append(chunk[beside_box])
        rays.append(of_chunk[beside_box])
        crossing.append(chunk[~beside_box])
    return torch.cat(beside), Rays.joined(rays), torch.cat(crossing)


def _observe_through_object(run: TrainingRun, pixels: Int[Tensor, "Q"], min_background: float) -> Observed:
    """Observe the background along those rays of pixels that cross hardly any content."""
    batches, renderer, scene = run.batches, run.renderer, run.renderer.scene
    view = batches.cameras.view_of(pixels)
    rays = _rays(run, pixels)
    path = renderer.trace(rays)
    neighbours = renderer.exit_directions(scene.camera(neighbour_rays(batches.cameras, pixels), view))
    widths = divergence(batches.cameras, pixels, main_exits(path), neighbours)
    steady = (widths < DIVERGENT).nonzero()[:, 0]
    path, rays = path.select_rays(steady), rays[steady]
    pixels, view, widths = pixels[steady], view[steady], widths[steady]
    rendering = renderer.render_path(path)[-1]
    fraction, exits = path.main_polyline(rendering.background_fraction), path.main_polyline(path.exits().directions)
    rgb = batches.photographed(pixels)
    difference = _photographed(run, rgb, view, rays) - rendering.radiance
    radiance = scene.background(Exits(exits)) + difference / fraction.clamp(min=min_background)
    # The width magnifies errors of the direction.
    weights = fraction.square().mean(-1) / widths.clamp(min=1).square()
    observed = Observed(exits, radiance, saturated(rgb), weights, widths / batches.cameras.fx[view])
    return observed[fraction.amin(-1) >= min_background]


def _observe_beside_object(
    run: TrainingRun, pixels: Int[Tensor, "Q"], rays: Rays, weight: float, fits_gains: bool = True
) -> Observed:
    """Observe the background along the rays of pixels beside the object, after the exposures are fitted to it."""
    batches, scene = run.batches, run.renderer.scene
    view, rgb, exposure = batches.cameras.view_of(pixels), batches.photographed(pixels), scene.camera.exposure
    if exposure is not None and fits_gains:
        exposure.fit(view, rays, scene.background(Exits.unbent(rays)), scene.colour_space.to_radiance(rgb))
    widths = 1 / batches.cameras.fx[view]
    seen = Exits.unbent(rays).directions
    return Observed(seen, _photographed(run, rgb, view, rays), saturated(rgb), torch.full_like(widths, weight), widths)


def _rays(run: TrainingRun, pixels: Int[Tensor, "Q"]) -> Rays:
    """Make the rays of the estimated cameras through the centres of pixels."""
    batches = run.batches
    return run.renderer.scene.camera(pixel_rays(batches.cameras, pixels), batches.cameras.view_of(pixels))


def _photographed(
    run: TrainingRun, rgb: Float[Tensor, "R 3"], view: Int[Tensor, "R"], rays: Rays
) -> Float[Tensor, "R 3"]:
    """Decode the colours of photographs, and divide by the gains of the photographs."""
    scene = run.renderer.scene
    radiance, gains = scene.colour_space.to_radiance(rgb), scene.camera.gains(view, rays)
    return radiance if gains is None else radiance / gains


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
