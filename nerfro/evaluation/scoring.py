"""Scores and error maps of the rendered views of a split, or of a folder of images.

Training refines cameras and exposures of training views only. Scores of test views that use such corrections, called
treatments, are listed separately, so that the scores under `test` always belong to the cameras and exposures of the
data set.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.camera.base import fit_gain
from nerfro.core.errors import NerfroError
from nerfro.core.light import ColourSpace, to_linear, tone_mapped
from nerfro.core.progress import duration, track
from nerfro.data.base import Views
from nerfro.data.image_files import Alpha, is_linear
from nerfro.evaluation.folders import ImagePair
from nerfro.evaluation.image_metrics import (
    ErrorMap,
    ImageMetric,
    ViewMaps,
    build_metrics,
    crop_rectangle,
    object_pixels,
    require_images,
)
from nerfro.evaluation.render_view import maps_of, render_view
from nerfro.evaluation.results import (
    AS_GIVEN,
    EXPOSED,
    FULL,
    OBJECT_REGIONS,
    OF_HALVES,
    TONE_MAPPED,
    UNEXPOSED,
    EvaluationResult,
    Region,
    Score,
    ViewScores,
)
from nerfro.files.images import round_to_8bit, save_image, save_png, sheet
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import Subdivision


class ImageMetrics(nn.Module):
    """Scores of each view: on the full image, on the object's mask and on the crop around the object.

    Args:
        names: names of the metrics; by default all registered ones.
    """

    def __init__(self, names: Sequence[str] | None = None) -> None:
        super().__init__()
        self.metrics: Mapping[str, ImageMetric] = build_metrics(names)
        self.modules_to_move = nn.ModuleList(self.metrics.values())  # `to` moves modules of such lists alone

    @torch.no_grad()
    def score(
        self,
        name: str,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        coverage: Float[Tensor, "H W"] | None = None,
        maps: ViewMaps | None = None,
    ) -> ViewScores:
        """Score one view.

        The prediction is clipped and rounded to 8 bits, so that the scores can be computed from the written image. The
        reference is clipped.

        Args:
            name: name of the view.
            prediction: rendered image, sRGB.
            target: reference image, sRGB.
            coverage: coverage of each pixel by the object in [0, 1]. Without it, or if the object is not visible, only
                the full image has scores.
            maps: further values of the pixels, for metrics that need these.

        Raises:
            NerfroError: the sizes differ, or a value is not finite.
        """
        require_images(prediction, target, coverage)
        target = target.clamp(0, 1)
        prediction = round_to_8bit(prediction)  # raises an error for values that are not finite
        regions: dict[Region, dict[str, Score]] = {}
        inside = None if coverage is None else object_pixels(coverage)
        if inside is not None and not inside.any():
            regions = self._missing()
        elif inside is not None:
            crop = crop_rectangle(inside)
            regions["mask"] = self._scores(prediction, target, inside, maps)
            regions["crop"] = self._scores(prediction[crop], target[crop], None, None if maps is None else maps[crop])
        return ViewScores(name, self._scores(prediction, target, None, maps), regions)

    def result(self, views: Sequence[ViewScores]) -> EvaluationResult:
        """Collect the scores of all views, with the reasons for missing scores."""
        if not views:
            raise NerfroError("no view was scored; choose a split that has views")
        if any(view.regions for view in views):
            views = [replace(view, regions=view.regions or self._missing()) for view in views]
        return EvaluationResult(tuple(views), self._notes(views))

    def _missing(self) -> dict[Region, dict[str, Score]]:
        return {region: dict.fromkeys(self.metrics) for region in OBJECT_REGIONS}

    def _scores(
        self, prediction: Tensor, target: Tensor, inside: Tensor | None, maps: ViewMaps | None
    ) -> dict[str, Score]:
        """Compute all scores; None if a metric is not available or the image is too small."""
        scores = {name: metric.score(prediction, target, inside, maps) for name, metric in self.metrics.items()}
        return {name: None if math.isnan(score) else score for name, score in scores.items()}

    def _notes(self, views: Sequence[ViewScores]) -> dict[str, str]:
        notes, first = {}, next(iter(self.metrics))
        unmasked = [view.name for view in views if view.regions and view.score(first, "mask") is None]
        if unmasked:
            notes["mask"] = f"the mask is missing or covers half of no pixel in {', '.join(unmasked)}"
        scored = [
            (view, region)
            for view in views
            for region in (FULL, *OBJECT_REGIONS)
            if view.score(first, region) is not None
        ]
        for name, metric in self.metrics.items():
            if metric.maps and all(view.score(name) is None for view in views):
                continue  # most data have no maps
            if any(view.score(name, region) is None for view, region in scored):
                too_small = f"images, masks or crops below {metric.min_size} pixels"
                notes[name] = metric.missing or (too_small if metric.min_size > 1 else "it has no value")
        return notes


@torch.no_grad()
def error_maps(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], metrics: Mapping[str, ImageMetric]
) -> list[ErrorMap]:
    """Compute the error maps of two images by all metrics that are available and have a map.

    Metrics for which the images are too small are omitted.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        metrics: metrics by name.
    """
    size = min(prediction.shape[:2])
    available = [metric for metric in metrics.values() if metric.missing is None and size >= metric.min_size]
    return [error for metric in available if (error := metric.error_map(prediction, target)) is not None]


def write_error_sheet(
    folder: Path,
    name: str,
    prediction: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
    metrics: Mapping[str, ImageMetric],
) -> None:
    """Write a prediction, its reference and its error maps in one row to `folder/errors/<name>.png`.

    Images are enlarged by a whole factor without smoothing, so that single pixels remain visible.
    """
    prediction, reference = prediction.clamp(0, 1), reference.clamp(0, 1)
    maps = error_maps(prediction, reference, metrics)
    images = [prediction, reference, *(error.colours() for error in maps)]
    captions = ["prediction", "reference", *(f"{error.title}, 0 to {error.limit:g}" for error in maps)]
    # Smaller images are enlarged, because captions need a width of 256 pixels.
    width = -(-256 // reference.shape[1]) * reference.shape[1]
    title = "error maps: black is 0, and pale yellow is the end of the scale or more"
    save_image(folder / "errors" / f"{name}.png", sheet(images, captions, width, len(images), title))


def score_split(
    renderer: Renderer, views: Views, metrics: ImageMetrics, folder: Path, subdivision: Subdivision, prefix: str
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score views with the given cameras, and once more for each applicable treatment.

    The treatments build on each other:

    - `aligned`: test cameras are moved by the similarity transformation from the given to the refined training cameras,
      and use the estimated lens.
    - `exposed`: in addition, each view and channel has a gain. Gains are fitted on the left halves of the photographs,
      and the right halves are scored. `unexposed` scores the same halves without gain.

    For photographs in linear light, `tone_mapped` scores the views as given after the curve `tone_mapped`, which
    distinguishes highlights. All other images are sRGB, clipped to [0, 1].

    The images are 8-bit sRGB, `folder/images/<prefix>_NNN.png` and `folder/images_<treatment>/<prefix>_NNN.png`.

    Args:
        renderer: trained model.
        views: views to score.
        metrics: metrics of an image.
        folder: folder of the evaluation.
        subdivision: which pixels get several rays.
        prefix: beginning of the names of the views, which end with a number of three digits.

    Returns:
        Scores with the given cameras, and the scores of each treatment by name.
    """
    scene, results, treatments = renderer.scene, dict[str, EvaluationResult](), [AS_GIVEN]
    settings = metrics, folder, subdivision, prefix
    if scene.colour_space is ColourSpace.HDR:
        treatments.append(TONE_MAPPED)
    if scene.camera.moves:
        results = _score_views(renderer, views, *settings, treatments)
        views, treatments = replace(views, cameras=scene.camera.aligned(views.cameras)), ["aligned"]
    if scene.camera.exposure is not None:
        treatments = [*treatments, *OF_HALVES]
    results |= _score_views(renderer, views, *settings, treatments)
    return results.pop(AS_GIVEN), results


def announce_scoring(
    renderer: Renderer, views: Views, metrics: ImageMetrics, subdivision: Subdivision, num_pixels: int = 4096
) -> None:
    """Print the estimated time of `score_split` and how to shorten it, if it takes five seconds or more.

    A small rendering of the first view and its scores are timed. An untrained model needs about as much time as a
    trained one, because its number of samples is the same.

    Args:
        renderer: model, on the device of the scoring.
        views: views to score.
        metrics: metrics of an image.
        subdivision: which pixels get several rays.
        num_pixels: number of pixels of the small rendering.
    """
    scene, cameras = renderer.scene, views.cameras
    reduction = max(1.0, math.sqrt(cameras.height * cameras.width / num_pixels))
    width, height = (max(1, round(side / reduction)) for side in (cameras.width, cameras.height))
    small, seconds = cameras.select([0]).resized(width, height).to(scene.device), 0.0
    for _ in range(2):  # the first rendering compiles kernels
        begun = time.perf_counter()
        radiance = render_view(renderer, small, 0, subdivision).radiance.view(height, width, 3).cpu()
        rgb = scene.colour_space.to_display(radiance)
        metrics.score("", rgb, rgb, None if views.masks is None else torch.ones(height, width))
        renderings = 2 if scene.camera.moves else 1  # see `aligned`
        ratio = renderings * len(views) * cameras.height * cameras.width / (height * width)
        seconds = ratio * (time.perf_counter() - begun)
        if seconds < 5:
            return
    fewer = f"trainer.limit_test_batches={-(-len(views) // 4)} scores fewer views, and " if len(views) > 1 else ""
    print(
        f"after the training, the scores of {len(views)} views take about {duration(seconds)} more, which "
        f"trainer.max_time does not include; {fewer}evaluation=none scores no view",
        flush=True,
    )


def _score_views(
    renderer: Renderer,
    views: Views,
    metrics: ImageMetrics,
    folder: Path,
    subdivision: Subdivision,
    prefix: str,
    treatments: Sequence[str],
) -> dict[str, EvaluationResult]:
    """Render all views once, and write and score the images by each treatment, of which only `exposed` changes images.

    The memory holds the rays and images of one view and the samples of `renderer.chunk_size` rays.
    """
    scene, height, width = renderer.scene, views.cameras.height, views.cameras.width
    cameras, left = views.cameras.to(scene.device), slice(width // 2)
    scores: dict[str, list[ViewScores]] = {treatment: [] for treatment in treatments}
    for view in track("evaluate", range(len(views))):
        rendered = render_view(renderer, cameras, view, subdivision)
        radiance, maps = rendered.radiance.view(height, width, 3).cpu(), maps_of(views, view, rendered)
        target, mask = views.images[view], None if views.masks is None else views.masks[view]
        name = f"{prefix}_{view:03d}"
        for treatment, scored in scores.items():
            gain = torch.ones(3)
            if treatment == EXPOSED:
                to_srgb, shown = scene.colour_space.to_srgb, radiance[:, left].flatten(0, 1)
                gain = fit_gain(to_srgb, shown, target[:, left].flatten(0, 1))
            rgb, reference = scene.colour_space.to_display(radiance, gain), target
            if treatment == TONE_MAPPED:
                rgb, reference = tone_mapped(radiance), tone_mapped(to_linear(target))
            if treatment != UNEXPOSED:
                save_png(folder / ("images" if treatment == AS_GIVEN else f"images_{treatment}") / f"{name}.png", rgb)
            part = slice(None), slice(width // 2 if treatment in OF_HALVES else 0, None)
            coverage = None if mask is None else mask[part].contiguous()
            shown, reference = rgb[part].contiguous(), reference[part].contiguous()
            scored.append(metrics.score(name, shown, reference, coverage, maps[part]))
    return {treatment: metrics.result(scored) for treatment, scored in scores.items()}


def score_folders(
    pairs: list[ImagePair],
    alpha: Alpha,
    metrics: ImageMetrics,
    folder: Path,
    device: torch.device,
) -> tuple[EvaluationResult, dict[str, EvaluationResult]]:
    """Score each prediction, and write error maps to `folder/errors`; return scores as `score_split` does."""
    metrics, scores, mapped = metrics.to(device), list[ViewScores](), list[ViewScores]()
    for pair in track("evaluate", pairs):
        prediction, reference, coverage = pair.load(alpha)
        prediction, reference = prediction.to(device), reference.to(device)
        coverage = None if coverage is None else coverage.to(device)
        scores.append(metrics.score(pair.name, prediction, reference, coverage))
        write_error_sheet(folder, pair.name, prediction, reference, metrics.metrics)
        if is_linear(pair.reference):
            prediction, reference = (tone_mapped(to_linear(image)) for image in (prediction, reference))
            mapped.append(metrics.score(pair.name, prediction, reference, coverage))
    return metrics.result(scores), {TONE_MAPPED: metrics.result(mapped)} if len(mapped) == len(scores) else {}
