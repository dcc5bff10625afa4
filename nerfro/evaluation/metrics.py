"""PSNR, the mean of any metric over pictures, and the metric that collects all of them over views and regions."""

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
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.regions import crop_rectangle, mean_over, object_pixels
from nerfro.evaluation.results import FULL, METRICS, OBJECT_REGIONS, EvaluationResult, Region, Score, ViewScores
from nerfro.evaluation.ssim import MS_SSIM_MIN_SIZE, WINDOW, ms_ssim, ssim
from nerfro.files.images import round_to_8bit

MAX_PSNR = 100.0  # dB; equal pictures would have infinity, which no mean, table or JSON file can hold
_REGIONS = (FULL, *OBJECT_REGIONS)

# A metric of two pictures [H, W, 3], sRGB in [0, 1], over all pixels or over those of a mask [H, W].
PictureMetric = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def psnr(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio of sRGB in [0, 1], -10 log10(mean squared error), in dB.

    At most 100: equal pictures, and those with a mean squared error below 1e-10, score `MAX_PSNR`.
    """
    errors = squared_error_map(prediction.double(), target.double())
    return (-10 * torch.log10(mean_over(errors, inside))).clamp(max=MAX_PSNR)


class MeanOverPictures(torchmetrics.Metric):
    """Mean of a metric over pictures: of `psnr`, `ssim`, `ms_ssim`, `flip` or an `LpipsNetwork`."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, metric: PictureMetric) -> None:
        """Start with no pictures."""
        super().__init__()
        self.metric = metric
        self.add_state("total", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", default=torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    @torch.no_grad()
    def update(
        self,
        prediction: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        inside: Bool[Tensor, "H W"] | None = None,
    ) -> None:
        """Add one picture, sRGB in [0, 1], or its pixels inside a mask."""
        self.total += self.metric(prediction, target, inside).double()
        self.count += 1

    def compute(self) -> Float[Tensor, ""]:
        """Mean of the pictures so far."""
        return self.total / self.count


class ImageMetrics(torchmetrics.Metric):
    """Every metric of each view: on the full image, and on the object's mask and the crop around it where it is known.

    With `round_predictions` predictions are clipped and rounded to 8 bits first, so that the numbers can be computed
    again from the pictures that were written; without, they are clipped only. Targets are taken as they are.
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
        """Start with no views.

        Args:
            lpips_networks: by the name of their metric, see `find_lpips_networks`; what is not there is left out.
            reasons: why a network is missing, by the same names.
            round_predictions: see above.
            prefix: views are named `<prefix>_<number, three digits>`.
        """
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
            prediction: rendered picture, sRGB.
            target: reference picture, sRGB in [0, 1].
            view: number of the view; by default they are counted. Processes that share the work must give it.
            coverage: share of each pixel that the object covers; without it only the full image is scored, and so it
                is where the object is not seen.
        """
        if prediction.shape != target.shape or prediction.ndim != 3 or prediction.shape[-1] != 3:
            raise NerfroError(
                f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
                "both must be [H, W, 3] and of one size"
            )
        if coverage is not None and coverage.shape != target.shape[:2]:
            raise NerfroError(f"a mask {list(coverage.shape)} does not fit a picture {list(target.shape)}; give [H, W]")
        rounded = round_to_8bit(prediction)  # also refuses what is not finite
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

    def compute(self) -> Float[Tensor, "V 1+K"]:
        """Scores of all views, gathered from all processes.

        A row for each view: its number, in rising order, then the scores on the full image in the order of `METRICS`,
        those on the mask and those on the crop; NaN where one is not available.
        """
        if len(self.rows) == 0:
            raise NerfroError("no view was scored; call update with at least one, or choose a split that has views")
        rows = dim_zero_cat(self.rows)
        # A distributed sampler hands some views out twice to give every process as many; they count once.
        by_view = {int(row[0]): row for row in rows}
        return torch.stack([by_view[number] for number in sorted(by_view)])

    def result(self, names: Sequence[str] | None = None) -> EvaluationResult:
        """The scores as named rows, with the reasons for what is missing; names are made from the prefix by default."""
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
        """All metrics in the order of `METRICS`; NaN for those that are absent, or need a larger picture."""
        metrics: dict[str, PictureMetric] = {"psnr": psnr, "ssim": ssim, "ms_ssim": ms_ssim, "flip": flip}
        metrics.update(self.lpips_networks.items())  # type: ignore[arg-type]
        scores = torch.full((len(METRICS),), torch.nan, dtype=torch.float64, device=prediction.device)
        for index, metric in enumerate(METRICS):
            if metric.name in metrics and min(prediction.shape[:2]) >= self.min_sizes.get(metric.name, 1):
                scores[index] = metrics[metric.name](prediction, target, inside)
        return scores

    def _notes(self, views: Sequence[ViewScores]) -> dict[str, str]:
        notes = {}
        unseen = [view.name for view in views if view.regions and view.score("psnr", "mask") is None]
        if unseen:
            notes["mask"] = f"the mask is missing or empty in {', '.join(unseen)}"
        for region in _REGIONS:
            seen = [view for view in views if view.score("psnr", region) is not None]
            for metric in METRICS:
                if any(view.score(metric.name, region) is None for view in seen):
                    notes[metric.name if region == FULL else f"{region}.{metric.name}"] = self._reason(
                        metric.name, region
                    )
        return notes

    def _reason(self, metric: str, region: Region) -> str:
        if metric.startswith("lpips") and metric not in self.lpips_networks:
            return self.reasons.get(metric, "no network was given")
        where = {FULL: "pictures", "mask": "pictures or masks", "crop": "crops"}[region]
        return f"{where} below {self.min_sizes[metric]} pixels"


def _named(scores: Sequence[float]) -> dict[str, Score]:
    pairs = zip(METRICS, scores, strict=True)
    return {metric.name: None if math.isnan(score) else score for metric, score in pairs}
