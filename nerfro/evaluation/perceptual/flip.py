"""FLIP: visibility of the difference between two images that alternate on a screen.

The values are computed by the authors' package flip-evaluator for low dynamic range (LDR) and its default viewing
conditions: 67 pixels per degree, that is, a display of 0.7 m width and 3840 pixels at a distance of 0.7 m.

Source:
    Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
"""

from __future__ import annotations

import importlib.util

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.evaluation.error_maps import ErrorMap
from nerfro.evaluation.image_metrics import ImageMetric
from nerfro.evaluation.regions import mean_over, require_images
from nerfro.registry.registration import register


def is_available() -> bool:
    """Test whether flip-evaluator is installed; the package has no wheel for Linux on ARM."""
    return importlib.util.find_spec("flip_evaluator") is not None


def flip_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Compute the visible difference of two images at each pixel.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].

    Returns:
        Values in [0, 1], float32; 0 for an invisible difference.
    """
    require_images(prediction, target)
    import flip_evaluator  # not available on every platform, see `is_available`

    images = [image.detach().cpu().float().contiguous().numpy() for image in (target, prediction)]
    errors, _, _ = flip_evaluator.evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0]).to(prediction.device)


def flip(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], inside: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Compute the mean of `flip_map`; lower is better.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        inside: mask of the pixels that count; by default, all pixels count.

    Returns:
        Mean in [0, 1], without unit; NaN for an empty mask.
    """
    require_images(prediction, target, inside)
    return mean_over(flip_map(prediction, target), inside)


@register("metric", "flip")
class Flip(ImageMetric):
    """FLIP, the difference that is visible when flipping between two images."""

    title = "FLIP"
    better = "lower"
    missing = None if is_available() else "the package flip-evaluator is not installed"
    forward = staticmethod(flip)

    def error_map(self, prediction: Tensor, target: Tensor) -> ErrorMap:
        return ErrorMap("flip", "FLIP", flip_map(prediction, target), 1.0)
