"""Scores of all views and regions of an evaluation."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.errors import NerfroError
from nerfro.evaluation.image_metrics import ImageMetric, build_metrics
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.regions import crop_rectangle, object_pixels, require_images
from nerfro.evaluation.results import FULL, OBJECT_REGIONS, EvaluationResult, Region, Score, ViewScores
from nerfro.files.images import round_to_8bit


class ImageMetrics(nn.Module):
    """All scores of each view: on the full image, on the object's mask and on the crop around the object.

    Args:
        lpips_networks: networks by metric, see `find_lpips_networks`. Metrics without a network are not available.
        reasons: reason for each missing network, by metric.
        round_predictions: whether to round predictions to 8 bits, so that the scores can be reproduced from the written
            images. Predictions are always clipped to [0, 1].
        prefix: views have the names `<prefix>_<three-digit number>`.
    """

    def __init__(
        self,
        lpips_networks: Mapping[str, LpipsNetwork] | None = None,
        reasons: Mapping[str, str] | None = None,
        round_predictions: bool = True,
        prefix: str = "test",
    ) -> None:
        super().__init__()
        self.metrics: Mapping[str, ImageMetric] = build_metrics(lpips_networks, reasons)
        self.modules_to_move = nn.ModuleList(self.metrics.values())  # `to` moves modules of such lists alone
        self.round_predictions = round_predictions
        self.prefix = prefix
        self.views: dict[int, ViewScores] = {}

    def emptied(self) -> ImageMetrics:
        """Return the same metrics without the scores of views."""
        empty = copy.copy(self)
        empty.views = {}
        return empty

    @torch.no_grad()
    def update(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        view: int | None = None,
        coverage: Float[Tensor, "H W"] | None = None,
    ) -> None:
        """Score one view.

        Args:
            prediction: rendered image, sRGB.
            target: reference image, sRGB in [0, 1].
            view: number of the view; by default, views are counted.
            coverage: coverage of each pixel by the object in [0, 1]. Without it, or if the object is not visible, only
                the full image is scored.

        Raises:
            NerfroError: the sizes differ, or a value is not finite.
        """
        require_images(prediction, target, coverage)
        rounded = round_to_8bit(prediction)  # raises an error for values that are not finite
        prediction = rounded if self.round_predictions else prediction.clamp(0, 1)
        regions: dict[Region, dict[str, Score]] = {}
        inside = None if coverage is None else object_pixels(coverage)
        if inside is not None and inside.any():
            crop = crop_rectangle(inside)
            regions["mask"] = self._score(prediction, target, inside)
            regions["crop"] = self._score(prediction[crop], target[crop], None)
        number = len(self.views) if view is None else view
        name = f"{self.prefix}_{number:03d}"
        self.views[number] = ViewScores(name, self._score(prediction, target, None), regions)

    def result(self, names: Sequence[str] | None = None) -> EvaluationResult:
        """Return the scores of all views by number, with the reasons for missing scores.

        Args:
            names: names of the views; by default, names use the prefix.
        """
        if not self.views:
            raise NerfroError("no view was scored; choose a split that has views")
        views = [self.views[number] for number in sorted(self.views)]
        if names is not None:
            views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
        if any(view.regions for view in views):
            missing: dict[Region, dict[str, Score]] = {region: dict.fromkeys(self.metrics) for region in OBJECT_REGIONS}
            views = [replace(view, regions=view.regions or missing) for view in views]
        return EvaluationResult(tuple(views), self._notes(views), "8bit" if self.round_predictions else "float")

    def _score(self, prediction: Tensor, target: Tensor, inside: Tensor | None) -> dict[str, Score]:
        """Compute all scores; None if a metric is not available or the image is too small."""
        scores = {name: metric.score(prediction, target, inside) for name, metric in self.metrics.items()}
        return {name: None if math.isnan(score) else score for name, score in scores.items()}

    def _notes(self, views: Sequence[ViewScores]) -> dict[str, str]:
        notes = {}
        unmasked = [view.name for view in views if view.regions and view.score("psnr", "mask") is None]
        if unmasked:
            notes["mask"] = f"the mask is missing or empty in {', '.join(unmasked)}"
        for region in (FULL, *OBJECT_REGIONS):
            scored = [view for view in views if view.score("psnr", region) is not None]
            where = {FULL: "images", "mask": "images or masks", "crop": "crops"}[region]
            for name, metric in self.metrics.items():
                if any(view.score(name, region) is None for view in scored):
                    undefined = "it has no value" if metric.min_size <= 1 else f"{where} below {metric.min_size} pixels"
                    reason = metric.missing or undefined
                    notes[name if region == FULL else f"{region}.{name}"] = reason
        return notes
