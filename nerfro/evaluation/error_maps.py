"""Error maps of two images, and their colours with a fixed scale in a perceptual colour map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.evaluation.regions import require_images
from nerfro.files.drawing import magma

# Squared error at the end of the colour scale; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05


@dataclass(frozen=True)
class ErrorMap:
    """Error at each pixel of an image.

    Attributes:
        name: name of the metric, as in file names.
        title: title of the colour scale.
        values: error [H, W]; 0 for equal pixels, NaN for pixels without a value.
        limit: value of the last colour of the scale, equal for all images.
    """

    name: str
    title: str
    values: Float[Tensor, "H W"]
    limit: float

    def colours(self) -> Float[Tensor, "H W 3"]:
        """Apply the magma colour map; the result is sRGB in [0, 1]."""
        return magma(self.values, self.limit)


def squared_error_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Compute the squared error of each pixel, averaged over channels. Its mean over the image determines the PSNR."""
    require_images(prediction, target)
    return (prediction - target).square().mean(-1)


def squared_error_colours(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Draw the squared error of each pixel in the colours of a fixed scale."""
    return magma(squared_error_map(prediction, target), SQUARED_ERROR_LIMIT)


def triptych(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H 3*W 3"]:
    """Concatenate prediction, reference and squared error for the training log, on the CPU and without text."""
    error = squared_error_colours(prediction, target)
    return torch.cat([prediction.detach().cpu().float().clamp(0, 1), target.detach().cpu().float(), error], dim=1)
