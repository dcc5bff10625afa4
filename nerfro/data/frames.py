"""From frames (an image, a pose, a lens) to views: what all loaders share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float

from nerfro.allowed import Coordinate, Range, check
from nerfro.cameras import Cameras, central_window
from nerfro.data.base import DataSource, Frame, Views
from nerfro.data.image_files import IMAGE_SUFFIXES, Alpha, read_rgb
from nerfro.data.masks import find_masks
from nerfro.data.pictures import Pictures
from nerfro.errors import NerfroError
from nerfro.lens import distort, undistort
from nerfro.paths import resolve_path

Every = Annotated[int, Range(at_least=2)]  # each such view is not trained on
SPLITS = ["train", "val", "test"]

_ROTATION_TOLERANCE = 1e-3

# Distorting what was undistorted must lead back to within this many pixels.
_LENS_TOLERANCE = 0.01


@dataclass(frozen=True)
class Lens:
    """Focal lengths and principal point in pixels, and distortion (see `nerfro.lens.coefficients`)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] | None = None

    @classmethod
    def of_angle(cls, angle: float, width: int, height: int) -> Lens:
        """The ideal lens with a horizontal field of view in radians and its principal point in the image's centre."""
        focal = 0.5 * width / math.tan(0.5 * angle)
        return cls(focal, focal, 0.5 * width, 0.5 * height)

    def resized(self, made_for: tuple[float, float], size: tuple[int, int], where: str) -> Lens:
        """The lens for images of a width and height, resized after calibration without a change of proportions."""
        by_width, by_height = size[0] / made_for[0], size[1] / made_for[1]
        if abs(by_width - by_height) > 1.5 * max(1 / made_for[0], 1 / made_for[1]):
            raise NerfroError(
                f"{where} is calibrated for {made_for[0]:g}x{made_for[1]:g} pixels but the images have "
                f"{size[0]}x{size[1]}, of other proportions; give the images that were calibrated"
            )
        return Lens(self.fx * by_width, self.fy * by_height, self.cx * by_width, self.cy * by_height, self.distortion)


class PosedImages(DataSource):
    """Image files with poses: what the built-in loaders share.

    Args:
        root: the folder.
        near, far: arc lengths at which rays begin and end, world units; None where the data will tell.
        downscale: how many times smaller pictures become, any number from 1 on; each pixel is the mean of what it
            covers, and the lens follows.
        alpha: `drop` ignores the images' transparency, `white` and `black` composite them over that colour.

    Raises:
        NerfroError: an option is out of range.
    """

    def __init__(self, root: str, near: float | None, far: float | None, downscale: float, alpha: Alpha) -> None:
        _require_interval(near, far)
        self.root = resolve_path(root)
        self.near, self.far, self.downscale, self.alpha = near, far, downscale, alpha

    @property
    def splits(self) -> list[str]:
        return SPLITS

    def require(self, split: str) -> None:
        """Refuse a root that is no folder, and an unknown split."""
        require_root(self.root)
        if split not in self.splits:
            raise NerfroError(f"data.root={self.root} has no split '{split}'; it has {', '.join(self.splits)}")

    def views(
        self,
        frames: Sequence[Frame],
        lenses: Callable[[int, int], Sequence[Lens]],
        axes: Literal["opengl", "opencv"],
        nearest: float = 0.0,
        farthest: float = math.inf,
        size: tuple[int, int] | None = None,
        crop: float = 1.0,
    ) -> Views:
        """Look at the frames' images and silhouettes, which are read when they are asked for, and set up their cameras.

        Args:
            frames: at least one.
            lenses: the frames' lenses for a width and height of the images as stored.
            axes: the camera axes of the poses: `opengl` (x right, y up, looks along -z) or `opencv` (y down, along +z).
            nearest, farthest: what the data tell, in place of bounds that are None.
            size: width and height of the images as stored, where the data set states them.
            crop: share of each side that is kept, around the centre.

        Raises:
            NerfroError: an image or mask is missing, no image or of the wrong size, or a lens has no inverse.
        """
        near, far = nearest if self.near is None else self.near, farthest if self.far is None else self.far
        _require_interval(near, far)
        files, alpha = [frame.image for frame in frames], self.alpha
        images = Pictures.of(files, lambda path: read_rgb(path, alpha), self.downscale, size, alpha != "drop", alpha)
        (height, width), stored = images.shape, images.size[::-1]
        masks = find_masks(files, [frame.mask for frame in frames], self.downscale, stored)
        full = lenses(*stored)
        for frame, lens in zip(frames, full, strict=True):
            focal, centre = Annotated[float, Range(at_least=1e-3, at_most=1e9)], Coordinate
            hints = {"fx": focal, "fy": focal, "cx": centre, "cy": centre}
            check(f"{frame.name}: its lens has ", hints, vars(lens))
        poses = np.stack([frame.camera_to_world for frame in frames])
        if axes == "opencv":
            poses = poses * np.array([1.0, -1.0, -1.0, 1.0])
        intrinsics = torch.tensor([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in full], dtype=torch.float64)
        smaller = torch.tensor([width / stored[0], height / stored[1]], dtype=torch.float64).repeat(2)
        fx, fy, cx, cy = (intrinsics * smaller).float().unbind(-1)
        distorted = any(lens.distortion is not None for lens in full)
        distortion = torch.tensor([lens.distortion or (0.0,) * 9 for lens in full]) if distorted else None
        cameras = Cameras(torch.from_numpy(poses).float(), fx, fy, cx, cy, width, height, near, far, distortion)
        _check_distortion(cameras, frames)
        if crop < 1:
            window = central_window(height, width, crop)
            cameras, images, masks = cameras.crop(window), images.cut(window), masks and masks.cut(window)
        return Views(cameras, images, masks, [frame.name for frame in frames], frames=frames)


def _require_interval(near: float | None, far: float | None) -> None:
    if far is not None and (near or 0.0) >= far:
        raise NerfroError(f"data.near={near} and data.far={far} are no interval; take 0 <= near < far")


def held_out(num_views: int, every: int, split: str, root: Path) -> list[int]:
    """The views of a split where the data has none: each `every`-th, from the first, is for val and test (LLFF)."""
    if num_views < 2:
        raise NerfroError(f"data.root={root} holds one image; two or more are needed to train on one and test another")
    return [i for i in range(num_views) if (i % every == 0) == (split != "train")]


def list_images(folder: Path) -> list[Path]:
    """The images of a folder by name, at least one; masks (`mask_*`) and hidden files are left out."""
    if not folder.is_dir():
        raise NerfroError(f"{folder} is not a folder; it should hold the images, see docs/data.md")
    images = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    images = [path for path in images if not path.name.startswith(("mask_", "."))]
    if not images:
        raise NerfroError(f"{folder} holds no image; see docs/data.md")
    return sorted(images)


def require_root(root: Path) -> None:
    """Refuse a data set's folder that does not exist."""
    if not root.is_dir():
        raise NerfroError(f"data.root={root} is not a folder; give the one that holds the data set")


def check_pose(
    matrix: Float[np.ndarray, "rows 4"], where: str, name: str = "transform_matrix"
) -> Float[np.ndarray, "3 4"]:
    """The first three rows of a camera-to-world matrix, which must be a rotation and a shift."""
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        cause = "mirrors" if error <= _ROTATION_TOLERANCE else f"is off by {error:.2g}"
        raise NerfroError(
            f"{where}: the 3x3 part of {name} is no rotation (it {cause}); "
            "give camera-to-world matrices without scale or reflection"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise NerfroError(f"{where}: the last row of {name} is {matrix[3].tolist()}; it must be 0, 0, 0, 1")
    check(f"{where}: position in ", {name: list[Coordinate]}, {name: matrix[:3, 3].tolist()})
    return matrix[:3]


def _check_distortion(cameras: Cameras, frames: Sequence[Frame]) -> None:
    """Refuse lenses whose model folds back within the image, as polynomials fitted to its middle may do."""
    if cameras.distortion is None:
        return
    share = torch.linspace(0, 1, 9, dtype=torch.float64)
    size = torch.tensor([cameras.width, cameras.height])
    grid = torch.cartesian_prod(share, share) * size  # the inside as well: a fold may lie within
    for view, frame in enumerate(frames):
        fx, fy, cx, cy = (getattr(cameras, name)[view].double() for name in ("fx", "fy", "cx", "cy"))
        points = (grid - torch.stack([cx, cy])) / torch.stack([fx, fy])
        lens = cameras.distortion[view].double().expand(len(points), 9)
        ideal, area = undistort(points, lens)
        error = (distort(ideal, lens)[0] - points).norm(dim=-1) * fx
        if not bool(((error < _LENS_TOLERANCE) & (area > 0)).all()):
            raise NerfroError(
                f"{frame.name}: its lens distortion cannot be undone everywhere in the image; "
                "check the coefficients and their order, or undistort the images first"
            )
