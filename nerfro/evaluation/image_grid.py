"""Labelled image grids: reference and methods side by side, with enlarged insets and error maps."""

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
    """A square crop of an image: position of its upper left corner and side, in pixels."""

    top: int
    left: int
    size: int

    def inside(self, height: int, width: int) -> bool:
        """Return whether the crop lies inside an image of the given size."""
        return min(self.top, self.left) >= 0 and self.top + self.size <= height and self.left + self.size <= width

    def of(self, image: Float[Tensor, "H W C"]) -> Float[Tensor, "size size C"]:
        """Crop an image; raises an error if the crop exceeds it."""
        height, width = image.shape[:2]
        if not self.inside(height, width):
            raise NerfroError(f"{self} exceeds an image of {height} x {width} pixels; choose another crop")
        return image[self.top : self.top + self.size, self.left : self.left + self.size]


@dataclass(frozen=True)
class ImageRow:
    """One view in a grid.

    Attributes:
        reference: ground truth, sRGB in [0, 1].
        predictions: the view rendered by each method, or None for a missing image.
        captions: text below each prediction, such as its PSNR; may be empty.
        crops: insets, which are shown enlarged below the images.
    """

    reference: Float[Tensor, "H W 3"]
    predictions: Sequence[Float[Tensor, "H W 3"] | None]
    captions: Sequence[str] = ()
    crops: Sequence[Crop] = ()


def image_grid(
    rows: Sequence[ImageRow],
    titles: Sequence[str],
    width: int = 256,
    error_limit: float = SQUARED_ERROR_LIMIT,
) -> Float[Tensor, "H W 3"]:
    """Draw views as rows and methods as columns.

    The first column shows the reference. Each row contains the images, the insets and the squared errors, with the
    colour scale in the first column. Images are enlarged without smoothing, so that single pixels remain visible.

    Args:
        rows: at least one view.
        titles: headings of the columns, including the reference.
        width: width of each column in pixels.
        error_limit: squared error at the end of the colour scale.

    Raises:
        NerfroError: there is no row, the number of titles or captions is wrong, or sizes differ within a row.
    """
    _check(rows, titles)
    across = len(titles) * (width + GAP) - GAP
    heading = paper(across, LINE_HEIGHT)
    for column, title in enumerate(titles):
        write(heading, title, column * (width + GAP) + width // 2, LINE_HEIGHT // 2)
    bands = [np.asarray(heading)]
    for index, row in enumerate(rows):
        if index > 0:
            bands.append(np.asarray(paper(across, ROW_GAP)))
        bands.append(_row_band(row, width, across, error_limit))
    return torch.from_numpy(np.concatenate(bands)).float() / 255


def triptych(
    prediction: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], error_limit: float = SQUARED_ERROR_LIMIT
) -> Float[Tensor, "H 3*W 3"]:
    """Concatenate prediction, reference and squared error for the training log, on the CPU and without text."""
    error = magma(squared_error_map(prediction, target), error_limit)
    return torch.cat([prediction.detach().cpu().float().clamp(0, 1), target.detach().cpu().float(), error], dim=1)


def most_different_crop(
    reference: Float[Tensor, "H W 3"],
    predictions: Sequence[Float[Tensor, "H W 3"]],
    size: int,
    apart_from: Sequence[Crop] = (),
) -> Crop:
    """Find the square in which methods differ most: the largest sum of the variances of the squared errors.

    With a single method, the square with the largest error is chosen.

    Args:
        reference: ground truth, sRGB in [0, 1].
        predictions: image of each method, sRGB in [0, 1].
        size: side of the square in pixels.
        apart_from: squares that the result must not overlap.

    Raises:
        NerfroError: there is no prediction, or there is no space for the square.
    """
    if not predictions or not 0 < size <= min(reference.shape[:2]):
        raise NerfroError(
            f"cannot choose a crop of {size} pixels among {len(predictions)} images of {list(reference.shape[:2])}; "
            "give at least one prediction and a smaller crop"
        )
    errors = torch.stack([squared_error_map(prediction, reference) for prediction in predictions])
    differences = errors.var(0, correction=0) if len(predictions) > 1 else errors[0]
    sums = F.avg_pool2d(differences.double()[None, None], size, stride=1)[0, 0]
    for taken in apart_from:
        rows = slice(max(taken.top - size + 1, 0), taken.top + taken.size)
        sums[rows, max(taken.left - size + 1, 0) : taken.left + taken.size] = -torch.inf
    if sums.isneginf().all():
        raise NerfroError(f"there is no space for another crop of {size} pixels; choose a smaller one")
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return Crop(top, left, size)


def _check(rows: Sequence[ImageRow], titles: Sequence[str]) -> None:
    if not rows:
        raise NerfroError("an image grid needs at least one row; give a rendered view")
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
                    f"a prediction {list(prediction.shape)} is shown beside a reference {list(row.reference.shape)}; "
                    "all images of a row must have the same size"
                )


def _row_band(row: ImageRow, width: int, across: int, error_limit: float) -> np.ndarray:
    """Draw one row of the grid: a column of cells for each image."""
    captions = ["", *row.captions] if row.captions else [None] * (1 + len(row.predictions))  # None reserves no space
    columns = [
        _column(row, image, caption, width, error_limit)
        for image, caption in zip([row.reference, *row.predictions], captions, strict=True)
    ]
    band = paper(across, columns[0].height)
    for index, column in enumerate(columns):
        band.paste(column, (index * (width + GAP), 0))
    return np.asarray(band)


def _column(row: ImageRow, image: Tensor | None, caption: str | None, width: int, error_limit: float) -> Image.Image:
    """Stack an image, its caption, its insets and its error map."""
    height = round(width * row.reference.shape[0] / row.reference.shape[1])
    cells = [_image_cell(row, image, width, height)]
    if caption is not None:
        cells.append(paper(width, LINE_HEIGHT))
        write(cells[-1], caption, width // 2, LINE_HEIGHT // 2)
    if row.crops:
        cells.append(_insets_cell(row.crops, image, width))
    if image is row.reference:
        cells.append(colour_scale(width, height, "squared error", error_limit))
    else:
        error = None if image is None else magma(squared_error_map(image.cpu(), row.reference.cpu()), error_limit)
        cells.append(fit(error, width, height))
    column = paper(width, sum(cell.height + GAP for cell in cells))
    top = 0
    for cell in cells:
        column.paste(cell, (0, top))
        top += cell.height + GAP
    return column


def _image_cell(row: ImageRow, image: Tensor | None, width: int, height: int) -> Image.Image:
    cell = fit(image, width, height)
    zoom = width / row.reference.shape[1]
    for crop, colour in zip(row.crops if image is not None else (), cycle(CROP_COLOURS), strict=False):
        left, top = round(zoom * crop.left), round(zoom * crop.top)
        right, bottom = round(zoom * (crop.left + crop.size)), round(zoom * (crop.top + crop.size))
        ImageDraw.Draw(cell).rectangle([left, top, right - 1, bottom - 1], outline=colour, width=2)
    return cell


def _insets_cell(crops: Sequence[Crop], image: Tensor | None, width: int) -> Image.Image:
    """Draw the insets side by side over the width of the column, with coloured frames."""
    side = (width - (len(crops) - 1) * GAP) // len(crops)
    cell = paper(width, side)
    for index, (crop, colour) in enumerate(zip(crops, cycle(CROP_COLOURS), strict=False)):
        inset = fit(None if image is None else crop.of(image), side, side)
        ImageDraw.Draw(inset).rectangle([0, 0, side - 1, side - 1], outline=colour, width=3)
        cell.paste(inset, (index * (side + GAP), 0))
    return cell
