"""PSNR, and a metric that collects the scores of all views and regions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
import torchmetrics
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torchmetrics.utilities import dim_zero_cat

from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import squared_error_map
from nerfro.evaluation.flip import flip
from nerfro.evaluation.flip import is_available as flip_available
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.regions import crop_rectangle, mean_over, object_pixels, require_images
from nerfro.evaluation.results import FULL, METRICS, OBJECT_REGIONS, EvaluationResult, Region, Score, ViewScores
from nerfro.evaluation.ssim import MS_SSIM_MIN_SIZE, WINDOW, ms_ssim, ssim
from nerfro.files.images import round_to_8bit

MAX_PSNR = 100.0  # dB; the infinite PSNR of equal images has no mean and no representation in JSON
_REGIONS = (FULL, *OBJECT_REGIONS)

# Metric of two images [H, W, 3], sRGB in [0, 1], over all pixels or over those of a mask [H, W].
ImageMetric = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def psnr(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the peak signal-to-noise ratio, -10 log10(mean squared error); higher is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        PSNR in dB, at most `MAX_PSNR`, which a mean squared error below 1e-10 reaches; NaN for an empty mask.

    Raises:
        NerfroError: the sizes of the images differ.
    """
    require_images(prediction, target, inside)
    errors = squared_error_map(prediction.double(), target.double())
    return (-10 * torch.log10(mean_over(errors, inside))).clamp(max=MAX_PSNR)


class ImageMetrics(torchmetrics.Metric):
    """All scores of each view: on the full image, on the object's mask and on the crop around the object.

    Args:
        lpips_networks: networks by metric, see `find_lpips_networks`. Metrics without a network are not available.
        reasons: reason for each missing network, by metric.
        round_predictions: whether to round predictions to 8 bits, so that the scores can be reproduced from the written
            images. Predictions are always clipped to [0, 1].
        prefix: views have the names `<prefix>_<three-digit number>`.
    """

    full_state_update = False
    rows: list[Tensor]

    def __init__(
        self,
        lpips_networks: Mapping[str, LpipsNetwork] | None = None,
        reasons: Mapping[str, str] | None = None,
        round_predictions: bool = True,
        prefix: str = "test",
    ) -> None:
        super().__init__()
        self.lpips_networks = nn.ModuleDict(lpips_networks or {})
        self.reasons = dict(reasons or {})
        self.min_sizes = {"ssim": WINDOW, "ms_ssim": MS_SSIM_MIN_SIZE}
        self.min_sizes.update({name: network.backbone.min_size for name, network in (lpips_networks or {}).items()})
        self.round_predictions = round_predictions
        self.prefix = prefix
        self.add_state("rows", default=[], dist_reduce_fx="cat")

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
            view: number of the view; by default, views are counted. It is required if several processes share the work.
            coverage: coverage of each pixel by the object in [0, 1]. Without it, or if the object is not visible, only
                the full image is scored.

        Raises:
            NerfroError: the sizes differ, or a value is not finite.
        """
        require_images(prediction, target, coverage)
        rounded = round_to_8bit(prediction)  # raises an error for values that are not finite
        prediction = rounded if self.round_predictions else prediction.clamp(0, 1)
        scores = torch.full((len(_REGIONS), len(METRICS)), torch.nan, dtype=torch.float64, device=prediction.device)
        scores[0] = self._score(prediction, target, None)
        inside = None if coverage is None else object_pixels(coverage)
        if inside is not None and inside.any():
            crop = crop_rectangle(inside)
            scores[1] = self._score(prediction, target, inside)
            scores[2] = self._score(prediction[crop], target[crop], None)
        number = scores.new_tensor([len(self.rows) if view is None else view])
        self.rows.append(torch.cat([number, scores.flatten()])[None])

    def compute(self) -> Float[Tensor, "V M"]:
        """Gather the scores of all views from all processes.

        Returns:
            One row per view, sorted by number: the number, followed by the scores of the full image, the mask and the
            crop, each in the order of `METRICS`. Missing scores are NaN.
        """
        if len(self.rows) == 0:
            raise NerfroError("no view was scored; choose a split that has views")
        rows = dim_zero_cat(self.rows)
        # A distributed sampler may repeat views to balance the processes; each view counts once.
        by_view = {int(row[0]): row for row in rows}
        return torch.stack([by_view[number] for number in sorted(by_view)])

    def result(self, names: Sequence[str] | None = None) -> EvaluationResult:
        """Return the scores by view name, with the reasons for missing scores; by default, names use the prefix."""
        rows = self.compute()
        if names is None:
            names = [f"{self.prefix}_{int(number):03d}" for number in rows[:, 0]]
        scores = rows[:, 1:].view(len(rows), len(_REGIONS), len(METRICS))
        has_masks = not scores[:, 1:].isnan().all()
        views = []
        for name, (full, *others) in zip(names, scores.tolist(), strict=True):
            regions = zip(OBJECT_REGIONS, others, strict=True) if has_masks else ()
            views.append(ViewScores(name, _named(full), {region: _named(row) for region, row in regions}))
        return EvaluationResult(tuple(views), self._notes(views), "8bit" if self.round_predictions else "float")

    def _score(self, prediction: Tensor, target: Tensor, inside: Tensor | None) -> Float[Tensor, "K"]:
        """Compute the scores in the order of `METRICS`; NaN if a network is missing or the image is too small."""
        metrics: dict[str, ImageMetric] = {"psnr": psnr, "ssim": ssim, "ms_ssim": ms_ssim}
        if flip_available():
            metrics["flip"] = flip
        metrics.update(self.lpips_networks.items())  # type: ignore[arg-type]
        scores = torch.full((len(METRICS),), torch.nan, dtype=torch.float64, device=prediction.device)
        for index, metric in enumerate(METRICS):
            if metric.name in metrics and min(prediction.shape[:2]) >= self.min_sizes.get(metric.name, 1):
                scores[index] = metrics[metric.name](prediction, target, inside)
        return scores

    def _notes(self, views: Sequence[ViewScores]) -> dict[str, str]:
        notes = {}
        unmasked = [view.name for view in views if view.regions and view.score("psnr", "mask") is None]
        if unmasked:
            notes["mask"] = f"the mask is missing or empty in {', '.join(unmasked)}"
        for region in _REGIONS:
            scored = [view for view in views if view.score("psnr", region) is not None]
            for metric in METRICS:
                if any(view.score(metric.name, region) is None for view in scored):
                    notes[metric.name if region == FULL else f"{region}.{metric.name}"] = self._reason(
                        metric.name, region
                    )
        return notes

    def _reason(self, metric: str, region: Region) -> str:
        if metric.startswith("lpips") and metric not in self.lpips_networks:
            return self.reasons.get(metric, "no network was given")
        if metric == "flip" and not flip_available():
            return "the package flip-evaluator is not installed"
        where = {FULL: "images", "mask": "images or masks", "crop": "crops"}[region]
        return f"{where} below {self.min_sizes[metric]} pixels"


def _named(scores: Sequence[float]) -> dict[str, Score]:
    pairs = zip(METRICS, scores, strict=True)
    return {metric.name: None if math.isnan(score) else score for metric, score in pairs}
