"""Labelled grids of pictures: reference and methods side by side, with enlarged insets and error maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import SQUARED_ERROR_LIMIT, squared_error_map
from nerfro.files.drawing import GAP, LINE_HEIGHT, colour_scale, fit, magma, paper, write

ROW_GAP = 18  # pixels between views
CROP_COLOURS = ((225, 60, 50), (45, 125, 235), (40, 165, 85))  # frames of the first, second, ... inset, in turn


@dataclass(frozen=True)
class Crop:
    """A square part of a picture, in pixels from the upper left corner."""

    top: int
    left: int
    size: int

    def inside(self, height: int, width: int) -> bool:
        """Whether it lies inside a picture."""
        return min(self.top, self.left) >= 0 and self.top + self.size <= height and self.left + self.size <= width

    def of(self, picture: Float[Tensor, "H W C"]) -> Float[Tensor, "size size C"]:
        """Cut the square out; refused if it does not lie inside the picture."""
        height, width = picture.shape[:2]
        if not self.inside(height, width):
            raise NerfroError(f"{self} does not lie inside a picture of {height} x {width} pixels; choose another one")
        return picture[self.top : self.top + self.size, self.left : self.left + self.size]


@dataclass(frozen=True)
class PictureRow:
    """One view in a grid."""

    reference: Float[Tensor, "H W 3"]  # ground truth, sRGB in [0, 1]
    predictions: Sequence[Float[Tensor, "H W 3"] | None]  # the same view by each method; None where a method has none
    label: str = ""  # written at the left, upwards; empty for none
    captions: Sequence[str] = ()  # a text below each prediction, such as its PSNR; empty for none
    crops: Sequence[Crop] = ()  # squares that are shown enlarged below the pictures


def picture_grid(
    rows: Sequence[PictureRow],
    titles: Sequence[str],
    width: int = 256,
    error_limit: float | None = SQUARED_ERROR_LIMIT,
) -> Float[Tensor, "H W 3"]:
    """Draw views as rows and methods as columns, the reference first, each `width` pixels across.

    Each row shows the pictures, below them the insets, below those the squared errors with their colour scale, up to
    `error_limit` or None for no errors, in the column of the reference. Pictures are enlarged without smoothing, so
    that pixels are seen as they are.

    Raises:
        NerfroError: if there is no row, titles or captions do not fit the predictions, or sizes differ in a row.
    """
    _check(rows, titles)
    margin = LINE_HEIGHT if any(row.label for row in rows) else 0
    across = margin + len(titles) * (width + GAP) - GAP
    heading = paper(across, LINE_HEIGHT)
    for column, title in enumerate(titles):
        write(heading, title, margin + column * (width + GAP) + width // 2, LINE_HEIGHT // 2)
    bands = [np.asarray(heading)]
    for index, row in enumerate(rows):
        if index > 0:
            bands.append(np.asarray(paper(across, ROW_GAP)))
        bands.append(_row_band(row, margin, width, across, error_limit))
    return torch.from_numpy(np.concatenate(bands)).float() / 255


def triptych(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], error_limit: float = SQUARED_ERROR_LIMIT
) -> Float[Tensor, "H 3W 3"]:
    """Prediction, reference and squared error side by side on the CPU, without text: the picture for a training log."""
    error = magma(squared_error_map(prediction, target), error_limit)
    return torch.cat([prediction.detach().cpu().float().clamp(0, 1), target.detach().cpu().float(), error], dim=1)


def most_telling_crop(
    reference: Float[Tensor, "H W 3"],
    predictions: Sequence[Float[Tensor, "H W 3"]],
    size: int,
    apart_from: Sequence[Crop] = (),
) -> Crop:
    """The square in which methods differ most: the largest sum of variances among their squared errors.

    By one method, the square of its largest error is taken. It does not overlap those of `apart_from`.

    Raises:
        NerfroError: if there is no prediction, or no room for the square.
    """
    if not predictions or not 0 < size <= min(reference.shape[:2]):
        raise NerfroError(
            f"cannot choose a crop of {size} pixels among {len(predictions)} pictures of {list(reference.shape[:2])}; "
            "give at least one prediction and a smaller crop"
        )
    errors = torch.stack([squared_error_map(prediction, reference) for prediction in predictions])
    interest = errors.var(0, correction=0) if len(predictions) > 1 else errors[0]
    sums = F.avg_pool2d(interest.double()[None, None], size, stride=1)[0, 0]
    for taken in apart_from:
        rows = slice(max(taken.top - size + 1, 0), taken.top + taken.size)
        sums[rows, max(taken.left - size + 1, 0) : taken.left + taken.size] = -torch.inf
    if sums.isneginf().all():
        raise NerfroError(f"no room for another crop of {size} pixels; choose a smaller one")
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return Crop(top, left, size)


def _check(rows: Sequence[PictureRow], titles: Sequence[str]) -> None:
    if not rows:
        raise NerfroError("a picture grid needs at least one row; give a view that was rendered")
    for row in rows:
        if len(row.predictions) + 1 != len(titles):
            raise NerfroError(
                f"{len(titles)} titles for a reference and {len(row.predictions)} predictions; give one for each column"
            )
        if row.captions and len(row.captions) != len(row.predictions):
            raise NerfroError(f"{len(row.captions)} captions for {len(row.predictions)} predictions; give one for each")
        for prediction in row.predictions:
            if prediction is not None and prediction.shape != row.reference.shape:
                raise NerfroError(
                    f"a prediction {list(prediction.shape)} stands beside a reference {list(row.reference.shape)}; "
                    "all pictures of a row must be of one size"
                )


def _row_band(row: PictureRow, margin: int, width: int, across: int, error_limit: float | None) -> np.ndarray:
    """One row of the grid: a column of stacked cells for each picture, and the row's label."""
    captions = ["", *row.captions] if row.captions else [None] * (1 + len(row.predictions))  # None: no room for them
    columns = [
        _column(row, picture, caption, width, error_limit)
        for picture, caption in zip([row.reference, *row.predictions], captions, strict=True)
    ]
    band = paper(across, columns[0].height)
    for index, column in enumerate(columns):
        band.paste(column, (margin + index * (width + GAP), 0))
    if row.label:
        label = paper(band.height, margin)
        write(label, row.label, band.height // 2, margin // 2)
        band.paste(label.rotate(90, expand=True), (0, 0))
    return np.asarray(band)


def _column(
    row: PictureRow, picture: Tensor | None, caption: str | None, width: int, error_limit: float | None
) -> Image.Image:
    """A picture, its caption, its insets and its error map, one above the other."""
    height = round(width * row.reference.shape[0] / row.reference.shape[1])
    cells = [_picture_cell(row, picture, width, height)]
    if caption is not None:
        cells.append(paper(width, LINE_HEIGHT))
        write(cells[-1], caption, width // 2, LINE_HEIGHT // 2)
    if row.crops:
        cells.append(_insets_cell(row.crops, picture, width))
    if error_limit is not None and picture is row.reference:
        cells.append(colour_scale(width, height, "squared error", error_limit))
    elif error_limit is not None:
        error = None if picture is None else magma(squared_error_map(picture.cpu(), row.reference.cpu()), error_limit)
        cells.append(fit(error, width, height))
    column = paper(width, sum(cell.height + GAP for cell in cells))
    top = 0
    for cell in cells:
        column.paste(cell, (0, top))
        top += cell.height + GAP
    return column


def _picture_cell(row: PictureRow, picture: Tensor | None, width: int, height: int) -> Image.Image:
    cell = fit(picture, width, height)
    zoom = width / row.reference.shape[1]
    for crop, colour in zip(row.crops if picture is not None else (), cycle(CROP_COLOURS), strict=False):
        left, top = round(zoom * crop.left), round(zoom * crop.top)
        right, bottom = round(zoom * (crop.left + crop.size)), round(zoom * (crop.top + crop.size))
        ImageDraw.Draw(cell).rectangle([left, top, right - 1, bottom - 1], outline=colour, width=2)
    return cell


def _insets_cell(crops: Sequence[Crop], picture: Tensor | None, width: int) -> Image.Image:
    """The crops side by side over the width of the column, framed in their colours."""
    side = (width - (len(crops) - 1) * GAP) // len(crops)
    cell = paper(width, side)
    for index, (crop, colour) in enumerate(zip(crops, cycle(CROP_COLOURS), strict=False)):
        inset = fit(None if picture is None else crop.of(picture), side, side)
        ImageDraw.Draw(inset).rectangle([0, 0, side - 1, side - 1], outline=colour, width=3)
        cell.paste(inset, (index * (side + GAP), 0))
    return cell
