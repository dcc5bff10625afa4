"""Sheets of images beside their references and error maps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.evaluation.error_maps import ErrorMap
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.files.drawing import sheet
from nerfro.files.images import save_image


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
