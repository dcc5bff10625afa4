"""Error maps of two images in a perceptual colour map with a fixed scale, and sheets of error maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfro.evaluation import flip
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.regions import require_images
from nerfro.evaluation.ssim import WINDOW, ssim_map
from nerfro.files.drawing import GAP, LINE_HEIGHT, colour_scale, fit, magma, paper, write
from nerfro.files.images import save_png

# Squared error at the end of the colour scale; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05
MIN_WIDTH = 256  # pixels; smaller images are enlarged in sheets, because titles need this width
_SCALE_HEIGHT = 64  # pixels


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
    lpips_networks: Mapping[str, LpipsNetwork] | None = None,
) -> list[ErrorMap]:
    """Compute the error maps of two images: squared error, 1 - SSIM, LPIPS with each given network, and FLIP.

    1 - SSIM and LPIPS are omitted for images that are too small. 1 - SSIM has no values in a border of five pixels,
    because windows there would exceed the image.

    Args:
        prediction: rendered image, sRGB in [0, 1].
        target: reference image, sRGB in [0, 1].
        lpips_networks: networks by name, see `find_lpips_networks`.
    """
    size = min(prediction.shape[:2])
    maps = [ErrorMap("squared_error", "squared error", squared_error_map(prediction, target), SQUARED_ERROR_LIMIT)]
    if size >= WINDOW:
        border = WINDOW // 2
        values = F.pad(1 - ssim_map(prediction, target).mean(-1), [border] * 4, value=torch.nan)
        maps.append(ErrorMap("ssim", "1 - SSIM", values, 1.0))
    for name, network in (lpips_networks or {}).items():
        if size >= network.backbone.min_size:
            title = f"LPIPS, {network.backbone.published.title}"
            with torch.no_grad():
                maps.append(ErrorMap(name, title, network.distance_map(prediction, target), 1.0))
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


def error_sheet(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], maps: Sequence[ErrorMap]
) -> Float[Tensor, "h w 3"]:
    """Draw a prediction, its reference and its error maps in one row, with the colour scale below each map.

    Images are enlarged by a whole factor without smoothing, so that single pixels remain visible.
    """
    zoom = -(-MIN_WIDTH // target.shape[1])
    height, width = zoom * target.shape[0], zoom * target.shape[1]
    titles = ["prediction", "reference", *(error.title for error in maps)]
    images = [prediction, target, *(error.colours() for error in maps)]
    scales = [None, None, *(colour_scale(width, _SCALE_HEIGHT, error.title, error.limit) for error in maps)]
    sheet = paper(len(titles) * (width + GAP) - GAP, LINE_HEIGHT + height + _SCALE_HEIGHT)
    for column, (title, image, scale) in enumerate(zip(titles, images, scales, strict=True)):
        left = column * (width + GAP)
        write(sheet, title, left + width // 2, LINE_HEIGHT // 2)
        sheet.paste(fit(image, width, height), (left, LINE_HEIGHT))
        if scale is not None:
            sheet.paste(scale, (left, LINE_HEIGHT + height))
    return torch.from_numpy(np.array(sheet)).float() / 255


def write_error_sheet(
    folder: Path,
    name: str,
    prediction: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
    networks: Mapping[str, LpipsNetwork],
) -> None:
    """Write the error maps of a view to `folder/errors/<name>.png`."""
    maps = error_maps(prediction, reference, networks)
    save_png(folder / "errors" / f"{name}.png", error_sheet(prediction, reference, maps))
