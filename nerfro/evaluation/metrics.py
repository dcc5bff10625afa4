"""Scores and error maps of all views and regions of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.evaluation.image_metrics import (
    ErrorMap,
    ImageMetric,
    ViewMaps,
    build_metrics,
    crop_rectangle,
    object_pixels,
    require_images,
)
from nerfro.evaluation.results import FULL, OBJECT_REGIONS, EvaluationResult, Region, Score, ViewScores
from nerfro.files.images import round_to_8bit, save_image, sheet


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
