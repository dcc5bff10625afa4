"""Image metrics in the conventions of torchmetrics."""

from __future__ import annotations

import torch
import torchmetrics
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.evaluation.image_metrics import ImageMetric, build_metrics
from nerfro.registry.registration import discover, find


def metrics(*names: str) -> torchmetrics.MetricCollection:
    """Return image metrics as a collection of torchmetrics, with named results.

    `update` takes batches of images [B, 3, H, W], sRGB in [0, 1]; `compute` returns the mean of each metric over all
    images, which is NaN if an image is too small for the metric.

    Args:
        names: registered metrics; by default, all that are available on this machine and need only images.

    Raises:
        NerfroError: a metric is unknown, or not available on this machine.
    """
    discover()
    for name in names:
        find("metric", name)
    built = build_metrics()
    for name in names:
        if built[name].missing is not None:
            raise NerfroError(f"metric={name} is not available: {built[name].missing}")
        if built[name].maps:
            raise NerfroError(f"metric={name} needs maps, which batches of images lack; use scene.evaluate(views)")
    usable = names or [name for name, metric in built.items() if metric.missing is None and not metric.maps]
    # Metrics with equal values are not the same metric, so torchmetrics must not group them.
    return torchmetrics.MetricCollection({name: MeanOverImages(built[name]) for name in usable}, compute_groups=False)


class MeanOverImages(torchmetrics.Metric):
    """Mean of an image metric over all images of all processes.

    Args:
        metric: the image metric.
    """

    full_state_update = False
    total: Tensor
    num_images: Tensor

    def __init__(self, metric: ImageMetric) -> None:
        super().__init__()
        self.metric = metric
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("num_images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    @property
    def higher_is_better(self) -> bool:  # type: ignore[override]
        return self.metric.better == "higher"

    @torch.no_grad()
    def update(self, preds: Tensor, target: Tensor) -> None:
        """Score a batch of predictions [B, 3, H, W] against references of the same shape."""
        if preds.ndim != 4 or preds.shape[1] != 3 or preds.shape != target.shape:
            raise NerfroError(
                f"images of shape {list(preds.shape)} and {list(target.shape)} cannot be compared; "
                "both must have the same shape [B, 3, H, W]"
            )
        for prediction, reference in zip(preds.permute(0, 2, 3, 1), target.permute(0, 2, 3, 1), strict=True):
            self.total += self.metric.score(prediction, reference)
        self.num_images += len(preds)

    def compute(self) -> Tensor:
        return self.total / self.num_images
