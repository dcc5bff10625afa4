"""PSNR, SSIM and LPIPS of single pictures, and the metric that collects them over views."""

from __future__ import annotations

import math

import torch
import torchmetrics
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure
from torchmetrics.utilities import dim_zero_cat

from nerfro.errors import NerfroError
from nerfro.evaluation.images import round_to_8bit
from nerfro.evaluation.lpips import MIN_PICTURE_SIZE as LPIPS_MIN_SIZE
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.results import METRICS, EvaluationResult, ViewScores

MAX_PSNR = 100.0  # dB; equal pictures would have infinity, which no mean, table or JSON file can hold
SSIM_WINDOW = 11  # pixels: a Gaussian of sigma 1.5, cut off at 3.5 sigma


def psnr(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio, -10 log10(mean squared error), in dB.

    Args:
        prediction: sRGB in [0, 1].
        target: sRGB in [0, 1].

    Returns:
        Decibels, at most 100: equal pictures, and those with a mean squared error below 1e-10, score `MAX_PSNR`.
    """
    value = peak_signal_noise_ratio(prediction.double(), target.double(), data_range=1.0)
    return value.clamp(max=MAX_PSNR)


def ssim_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """Structural similarity at each pixel and channel whose whole window lies inside the picture.

    Gaussian window of 11 pixels and sigma 1.5, weighted (not unbiased) covariances, K = (0.01, 0.03), range 1; in
    double precision, since variances are differences of nearly equal numbers. Source: Wang et al., "Image quality
    assessment: from error visibility to structural similarity", 2004, Eqn. 13 to 16.

    Args:
        prediction: sRGB in [0, 1].
        target: sRGB in [0, 1].

    Returns:
        Similarity in [-1, 1], five pixels smaller on each side.

    Raises:
        NerfroError: if the picture is smaller than the window.
    """
    if min(prediction.shape[:2]) < SSIM_WINDOW:
        raise NerfroError(f"SSIM needs at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, got {list(prediction.shape[:2])}")
    predictions, targets = (image.double().permute(2, 0, 1)[None] for image in (prediction, target))
    _, full = structural_similarity_index_measure(
        predictions, targets, sigma=1.5, data_range=1.0, return_full_image=True
    )
    # torchmetrics pads by reflection and averages over the padded windows too; the border is cut off here.
    border = SSIM_WINDOW // 2
    return full[0].permute(1, 2, 0)[border:-border, border:-border]


def ssim(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Structural similarity, the mean of `ssim_map` over pixels and channels."""
    return ssim_map(prediction, target).mean()


class ImageMetrics(torchmetrics.Metric):
    """PSNR, SSIM and LPIPS of each view.

    With `round_predictions` (the default) predictions are clipped and rounded to 8 bits first, so that the numbers can
    be computed again from the pictures that were written; without, they are clipped only. Targets are taken as they
    are.

    Example:
        ```
        metrics = ImageMetrics(*find_lpips_network())
        for prediction, target in views:
            metrics.update(prediction, target)
        metrics.result().means
        ```
    """

    full_state_update = False
    rows: list[Tensor]

    def __init__(
        self,
        lpips_network: LpipsNetwork | None,
        lpips_note: str = "",
        round_predictions: bool = True,
        prefix: str = "test",
    ) -> None:
        """Start with no views.

        Args:
            lpips_network: the network of LPIPS; None to go without.
            lpips_note: the reason why there is none.
            round_predictions: whether predictions are rounded to 8 bits before they are scored.
            prefix: views are named `<prefix>_<number, three digits>`.
        """
        super().__init__()
        self.lpips_network = lpips_network
        self.lpips_note = lpips_note or "no LPIPS network was given"
        self.round_predictions = round_predictions
        self.prefix = prefix
        self.add_state("rows", default=[], dist_reduce_fx="cat")

    @torch.no_grad()
    def update(
        self, prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], view: int | None = None
    ) -> None:
        """Score one view.

        Args:
            prediction: rendered picture, sRGB.
            target: reference picture, sRGB in [0, 1].
            view: number of the view; by default they are counted. Processes that share the work must give it.

        Raises:
            NerfroError: if the shapes differ, or a value is NaN or infinite.
        """
        if prediction.shape != target.shape or prediction.ndim != 3 or prediction.shape[-1] != 3:
            raise NerfroError(
                f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
                "both must be [H, W, 3] and of one size"
            )
        rounded = round_to_8bit(prediction)  # also refuses what is not finite
        prediction = rounded if self.round_predictions else prediction.clamp(0, 1)
        size = min(prediction.shape[:2])
        row = torch.full((1 + len(METRICS),), torch.nan, dtype=torch.float64, device=prediction.device)
        row[0] = len(self.rows) if view is None else view
        row[1] = psnr(prediction, target)
        if size >= SSIM_WINDOW:
            row[2] = ssim(prediction, target)
        if self.lpips_network is not None and size >= LPIPS_MIN_SIZE:
            row[3] = self.lpips_network(prediction, target)
        self.rows.append(row[None])

    def compute(self) -> Float[Tensor, "V 4"]:
        """Scores of all views, gathered from all processes.

        Returns:
            A row for each view: its number, in rising order, then the scores in the order of `METRICS`; NaN where a
            metric is not available.

        Raises:
            NerfroError: if no view was scored.
        """
        if len(self.rows) == 0:
            raise NerfroError("no view was scored; call update with at least one, or choose a split that has views")
        rows = dim_zero_cat(self.rows)
        # A distributed sampler hands some views out twice to give every process as many; they count once.
        by_view = {int(row[0]): row for row in rows}
        return torch.stack([by_view[number] for number in sorted(by_view)])

    def result(self) -> EvaluationResult:
        """The scores as named rows, with the reasons for what is missing.

        Raises:
            NerfroError: if no view was scored.
        """
        views = []
        for number, *scores in self.compute().tolist():
            named = zip((metric.name for metric in METRICS), scores, strict=True)
            row = {name: None if math.isnan(score) else score for name, score in named}
            views.append(ViewScores(f"{self.prefix}_{int(number):03d}", row))
        notes = self._notes(views)
        return EvaluationResult(tuple(views), notes, "8bit" if self.round_predictions else "float")

    def _notes(self, views: list[ViewScores]) -> dict[str, str]:
        notes = {}
        if any(view.scores["ssim"] is None for view in views):
            notes["ssim"] = f"pictures smaller than its window of {SSIM_WINDOW} pixels"
        if any(view.scores["lpips"] is None for view in views):
            too_small = f"pictures smaller than the {LPIPS_MIN_SIZE} pixels that AlexNet needs"
            notes["lpips"] = self.lpips_note if self.lpips_network is None else too_small
        return notes
