"""Where two pictures differ: error at each pixel, in a perceptual colour map of a fixed scale, and sheets of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.flip import flip_map
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.ssim import WINDOW, ssim_map
from nerfro.files.drawing import GAP, LINE_HEIGHT, colour_scale, fit, magma, paper, write
from nerfro.files.images import save_png

# Squared errors from 0 to this value are told apart; 0.05 is a difference of 0.22 in every channel.
SQUARED_ERROR_LIMIT = 0.05
MIN_WIDTH = 256  # pixels; smaller pictures are enlarged to it in sheets, so that titles have room
_SCALE_HEIGHT = 64  # pixels


@dataclass(frozen=True)
class ErrorMap:
    """Error at each pixel of a picture."""

    name: str  # of the metric, as in file names
    title: str  # what the values are, written at the colour scale
    values: Float[Tensor, "H W"]  # 0 where there is no error; NaN where there is no value
    limit: float  # value of the last colour of the scale, the same for all pictures

    def colours(self) -> Float[Tensor, "H W 3"]:
        """The map in magma, sRGB in [0, 1]."""
        return magma(self.values, self.limit)


def error_maps(
    prediction: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    lpips_networks: Mapping[str, LpipsNetwork] | None = None,
) -> list[ErrorMap]:
    """All error maps that two pictures allow: squared error, 1 - SSIM, LPIPS with each network given, and FLIP.

    1 - SSIM and LPIPS are left out where the picture is too small for them. 1 - SSIM has no values on the border of
    five pixels, whose windows stick out of the picture.
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
    return [*maps, ErrorMap("flip", "FLIP", flip_map(prediction, target), 1.0)]


def squared_error_map(prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Squared error of each pixel, mean over channels; its mean over the picture is what PSNR measures."""
    if prediction.shape != target.shape:
        raise NerfroError(
            f"cannot compare a prediction {list(prediction.shape)} with a reference {list(target.shape)}; "
            "both must be of one size"
        )
    return (prediction - target).square().mean(-1)


def error_sheet(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], maps: Sequence[ErrorMap]
) -> Float[Tensor, "h w 3"]:
    """Draw a prediction, its reference and its error maps in one row, with the colour scale below each map.

    Pictures are enlarged by a whole number, without smoothing, so that pixels are seen as they are.
    """
    zoom = -(-MIN_WIDTH // target.shape[1])
    height, width = zoom * target.shape[0], zoom * target.shape[1]
    titles = ["prediction", "reference", *(error.title for error in maps)]
    pictures = [prediction, target, *(error.colours() for error in maps)]
    scales = [None, None, *(colour_scale(width, _SCALE_HEIGHT, error.title, error.limit) for error in maps)]
    sheet = paper(len(titles) * (width + GAP) - GAP, LINE_HEIGHT + height + _SCALE_HEIGHT)
    for column, (title, picture, scale) in enumerate(zip(titles, pictures, scales, strict=True)):
        left = column * (width + GAP)
        write(sheet, title, left + width // 2, LINE_HEIGHT // 2)
        sheet.paste(fit(picture, width, height), (left, LINE_HEIGHT))
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
    """Write a view's error maps to `folder/errors/<name>.png`."""
    maps = error_maps(prediction, reference, networks)
    save_png(folder / "errors" / f"{name}.png", error_sheet(prediction, reference, maps))
