"""Error maps of two images in a perceptual colour map with a fixed scale, and sheets of error maps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfro.evaluation import flip
from nerfro.evaluation.lpips import MIN_SIZE, NO_NETWORK, LpipsNetwork, MissingNetwork
from nerfro.evaluation.regions import require_images
from nerfro.evaluation.ssim import WINDOW, ssim_map
from nerfro.files.drawing import magma, sheet
from nerfro.files.images import save_image

# Squared error at the end of the colour scale; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05
_MIN_WIDTH = 256  # pixels; smaller images are enlarged in sheets, because captions need this width


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


def error_maps(
    prediction: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    lpips: LpipsNetwork | MissingNetwork = NO_NETWORK,
) -> list[ErrorMap]:
    """Compute the error maps of two images: squared error, 1 - SSIM, LPIPS if a network is given, and FLIP.

    1 - SSIM and LPIPS are omitted for images that are too small. 1 - SSIM has no values in a border of five pixels,
    because windows there would exceed the image.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        lpips: network of LPIPS, see `find_lpips_network`.
    """
    size = min(prediction.shape[:2])
    maps = [ErrorMap("squared_error", "squared error", squared_error_map(prediction, target), SQUARED_ERROR_LIMIT)]
    if size >= WINDOW:
        border = WINDOW // 2
        values = F.pad(1 - ssim_map(prediction, target).mean(-1), [border] * 4, value=torch.nan)
        maps.append(ErrorMap("ssim", "1 - SSIM", values, 1.0))
    if not isinstance(lpips, MissingNetwork) and size >= MIN_SIZE:
        with torch.no_grad():
            maps.append(ErrorMap("lpips", "LPIPS", lpips.distance_map(prediction, target), 1.0))
    if flip.is_available():
        maps.append(ErrorMap("flip", "FLIP", flip.flip_map(prediction, target), 1.0))
    return maps


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


def write_error_sheet(
    folder: Path,
    name: str,
    prediction: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
    lpips: LpipsNetwork | MissingNetwork,
) -> None:
    """Write a prediction, its reference and its error maps in one row to `folder/errors/<name>.png`.

    Images are enlarged by a whole factor without smoothing, so that single pixels remain visible.
    """
    maps = error_maps(prediction, reference, lpips)
    images = [prediction, reference, *(error.colours() for error in maps)]
    captions = ["prediction", "reference", *(f"{error.title}, 0 to {error.limit:g}" for error in maps)]
    width = -(-_MIN_WIDTH // reference.shape[1]) * reference.shape[1]
    title = "error maps: black is 0, and pale yellow is the end of the scale or more"
    save_image(folder / "errors" / f"{name}.png", sheet(images, captions, width, len(images), title))
