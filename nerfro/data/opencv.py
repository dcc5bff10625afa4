"""Data format of the captured scenes of the paper."""

from __future__ import annotations

import warnings
from typing import Annotated

import numpy as np

from nerfro.allowed import Distance, Factor, Range
from nerfro.data.frames import FrameSet, Lens, PosedImages
from nerfro.data.image_files import Alpha, read_size
from nerfro.data.transforms import Manifest, find_splits, is_number, parse_matrix, read_manifest
from nerfro.errors import NerfroError
from nerfro.lens import opencv_coefficients
from nerfro.registry import register


@register("data", "opencv")
class OpenCVData(PosedImages):
    """Read the format of the paper's captured scenes: `transforms_{train,val,test}.json` with one 3x3 camera matrix.

    Poses have OpenCV camera axes. The centre of pixel (column, row) is at (column + 0.5, row + 0.5), as in the code of
    the paper's authors.

    Args:
        root, near, far, downscale, alpha: see `PosedImages`. The camera matrix belongs to the images in full size.
        eval_crop: fraction of each side that is kept around the centre, for the images of every split except train.
    """

    def __init__(
        self,
        root: str,
        near: Distance = 0.2,
        far: Distance = 12.0,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        eval_crop: Annotated[float, Range(more_than=0, at_most=1)] = 1.0,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        self.eval_crop = eval_crop

    @property
    def splits(self) -> list[str]:
        return list(find_splits(self.root))

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        where = f"{manifest.path}: cam_mat"
        matrix = parse_matrix(manifest.require("cam_mat", "the 3x3 camera matrix in pixels"), ((3, 3),), where)
        fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        if fx <= 0 or fy <= 0 or abs(matrix[0, 1]) > 1e-6 * fx or abs(matrix[1, 0]) > 1e-6 * fy:
            raise NerfroError(f"{where} must have positive focal lengths and no skew; it is {matrix.tolist()}")
        if np.abs(matrix[2] - [0, 0, 1]).max() > 1e-6:
            raise NerfroError(f"{where} must have the last row 0, 0, 1; it has {matrix[2].tolist()}")
        width, height, _ = read_size(manifest.frames[0].image)
        if not (0 < cx < width and 0 < cy < height):
            warnings.warn(
                f"{where} has its principal point ({cx:g}, {cy:g}) outside the {width}x{height} pixels of the images; "
                "check that it belongs to this image size",
                stacklevel=3,
            )
        lenses = [Lens(fx, fy, cx, cy, _distortion(manifest))] * len(manifest.frames)
        crop = 1.0 if split == "train" else self.eval_crop
        return FrameSet(manifest.frames, lenses, "opencv", size=manifest.size, crop=crop)


def _distortion(manifest: Manifest) -> tuple[float, ...] | None:
    """Parse the optional `dist`: 4, 5 or 8 distortion coefficients in OpenCV's order."""
    numbers = manifest.document.get("dist", [])
    # cv2.calibrateCamera returns a matrix with one row.
    if isinstance(numbers, list) and len(numbers) == 1 and isinstance(numbers[0], list):
        (numbers,) = numbers
    if not isinstance(numbers, list) or len(numbers) not in (0, 4, 5, 8) or not all(map(is_number, numbers)):
        raise NerfroError(
            f"{manifest.path}: dist={numbers!r} must be 4, 5 or 8 numbers in OpenCV's order: k1, k2, p1, p2, k3, ..."
        )
    return opencv_coefficients(numbers)
