"""A view's prediction, reference and error maps side by side, each map with its colour scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.evaluation.error_maps import ErrorMap, error_maps
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.files.drawing import GAP, LINE_HEIGHT, colour_scale, fit, paper, write
from nerfro.files.images import save_png

MIN_WIDTH = 256  # pixels; smaller pictures are enlarged to it, so that titles have room
_SCALE_HEIGHT = 64  # pixels


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
