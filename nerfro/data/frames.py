"""Common part of the built-in data formats: from posed frames to views, and bounds of their rays."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args

import numpy as np
import torch
from annotated_types import Ge
from jaxtyping import Float

from nerfro.core.cameras import Cameras, central_window, room_rotations
from nerfro.core.errors import NerfroError, first_of
from nerfro.core.paths import refuse_root, resolve_path
from nerfro.data.base import SPLITS, DataSource, Frame, Views
from nerfro.data.image_files import DEPTH, VIEW_SUFFIXES, Alpha, depths_of_points, read_depths, read_rgb, suffix_list
from nerfro.data.lazy_images import LazyImages
from nerfro.data.lenses import Lens, check_lenses, lens_tensors
from nerfro.data.masks import find_mask, find_masks, find_usable, require_used, unused_masks
from nerfro.files.reading import same_content
from nerfro.geometry.lines import nearest_point
from nerfro.registry.allowed import Coordinate, Distance, Factor, check, validated

_MAX_COORDINATE = get_args(Coordinate)[2].le  # world units


def find_bounds(
    poses: Float[np.ndarray, "V 3 4"], edges: Float[np.ndarray, "V 2 2"], points: Float[np.ndarray, "points 3"]
) -> tuple[float, float]:
    """Estimate the near and far bounds of all cameras.

    With points, the bounds are 0.9 times the distance of the nearest point in any view and 1.1 times the distance of
    the farthest one. Without points, they follow from the target, the point nearest to all optical axes: near is a
    tenth of the distance of the nearest camera, far is twice the distance of the farthest camera.

    Args:
        poses: camera-to-world matrices with OpenGL axes, world units.
        edges: lower left and upper right corner of each image at unit depth, see `image_edges`.
        points: sparse points in world units; may be empty.

    Returns:
        Near and far, arc lengths in world units.

    Raises:
        NerfroError: no points are in view and the cameras have no common target.
    """
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    distances_in_view = [_distances_in_view(points, *camera) for camera in zip(poses, edges, strict=True)]
    quantiles = [0.001, 1 - 0.001]  # outliers at both ends are left out
    ranges = np.array([np.quantile(distances, quantiles) for distances in distances_in_view if len(distances)])
    if len(ranges):
        return 0.9 * float(ranges[:, 0].min()), 1.1 * float(ranges[:, 1].max())
    to_target = nearest_point(centres, forward) - centres
    distances = np.linalg.norm(to_target, axis=1)
    sees_target = (to_target * forward).sum(1) > 0.87 * distances
    # The cameras share a target if it lies in front of at least 90 % of them, within 30 degrees of the optical axis.
    if sees_target.mean() < 0.9 or not distances.min() > 0:
        raise NerfroError(
            "data.near and data.far cannot be found: the cameras have no common target, and the data set has no sparse "
            "points; set both, in world units"
        )
    return 0.1 * float(distances.min()), 2 * float(distances.max())


def image_edges(lens: Lens, width: int, height: int) -> Float[np.ndarray, "2 2"]:
    """Return the lower left and the upper right corner of an image at unit depth, x right and y up, undistorted."""
    left, right = -lens.cx / lens.fx, (width - lens.cx) / lens.fx
    return np.array([[left, (lens.cy - height) / lens.fy], [right, lens.cy / lens.fy]])


def usable_points(points: Float[np.ndarray, "points 3"], file: Path) -> Float[np.ndarray, "usable 3"]:
    """Return the points of a file within the coordinates that nerfro accepts; outliers may lie beyond these.

    Raises:
        NerfroError: a coordinate is NaN or infinite.
    """
    if not np.isfinite(points).all():
        raise NerfroError(f"{file} holds points that are NaN or infinite; export the reconstruction again")
    return points[(np.abs(points) <= _MAX_COORDINATE).all(1)]


def _distances_in_view(
    points: Float[np.ndarray, "points 3"], pose: Float[np.ndarray, "3 4"], edges: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, " usable"]:
    """Compute the distances of the points inside the view frustum; distortion is neglected."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    low, high = edges[:, None] * -local[:, 2:]
    inside = ((low < local[:, :2]) & (local[:, :2] < high)).all(1)
    return np.linalg.norm(local[inside], axis=1)


Every = Annotated[int, Ge(2)]  # every n-th view is a test view
Item = TypeVar("Item")

_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class FrameSet:
    """Frames of one split as a data format describes them; the result of `PosedImages.read`.

    Attributes:
        frames: at least one frame.
        lenses: one lens per frame, for the images in their stored size.
        axes: camera axes of the poses: `opengl` (x right, y up, viewing direction -z) or `opencv` (y down, +z).
        near, far: bounds of the rays (arc lengths, world units) that apply where the options leave these open.
        crop: fraction of each side that is kept around the centre.
        usable: masks of the pixels that training may use, one per frame; empty if all pixels are usable.
        depths: depth images, one per frame; empty if there are none, see `nerfro.data.image_files`.
        depth_unit: world units per level of the depth images.
        points: 3-D points that each frame has observed, world units, which give depths; empty if there are none.
        turntable: whether the object turns, or its axis, where the options leave this open; see `turntable_of`.
    """

    frames: Sequence[Frame]
    lenses: Sequence[Lens]
    axes: Literal["opengl", "opencv"]
    near: float = 0.0
    far: float = math.inf
    crop: float = 1.0
    usable: Sequence[Path | None] = ()
    depths: Sequence[Path | None] = ()
    depth_unit: float = 1.0
    points: Sequence[Float[np.ndarray, "_ 3"]] = ()
    turntable: bool | tuple[float, ...] = False


@validated("data")
class PosedImages(DataSource):
    """Base class of the built-in data formats. A format implements `read` and, if it defines splits, `splits`.

    Args:
        root: folder of the data set.
        near: arc length at which rays begin, world units; None for the value of the data set.
        far: arc length at which rays end, world units; None for the value of the data set.
        downscale: downscaling factor of each side, any number from 1. Each pixel becomes the mean of the area that it
            covers, and the intrinsics are scaled accordingly.
        alpha: `drop` ignores transparency; `white` and `black` composite the images over this colour.
        mask_labels: labels of the object in the masks, as indices of palette images or as grey levels; None to use all
            labels but the background.
        turntable: whether the object turns before a camera that stands still, and the poses are relative to the object.
            None for the key `turntable` of a transforms file, or false.
        turntable_axis: axis of rotation in the world, upwards, of an object that turns before a camera at several
            heights; None for the key `turntable_axis` of a transforms file, or one camera that stands still.

    Raises:
        NerfroError: an option is out of range.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        mask_labels: list[int] | None = None,
        turntable: bool | None = None,
        turntable_axis: list[float] | None = None,
    ) -> None:
        _check_bounds(near, far)
        self._turntable = turntable_of("data.", turntable, turntable_axis)
        self.root = resolve_path(root)
        self.near, self.far, self.downscale, self.alpha, self.mask_labels = near, far, downscale, alpha, mask_labels
        self._images_of_masks: dict[Path, Path] = {}

    def split_files(self) -> Mapping[str, Path]:
        """Return the file that states the cameras of each split; empty if one file states the cameras of all splits."""
        return {}

    @property
    def splits(self) -> list[str]:
        return list(self.split_files()) or SPLITS

    def cameras_of(self, file: Path) -> Cameras | None:
        files = self.split_files() if self.root.is_dir() else {}
        split = next((name for name, own in files.items() if same_content(own, file)), None)
        return None if split is None else self.load(split).cameras

    @abstractmethod
    def read(self, split: str) -> FrameSet:
        """Read the poses, intrinsics and file names of one split; `load` has checked that the split exists.

        Raises:
            NerfroError: a file is missing, or a pose or lens is invalid.
        """

    def load(self, split: str) -> Views:
        require_root(self.root)
        if split not in self.splits:
            raise NerfroError(f"data.root={self.root} has no split '{split}'; it has {', '.join(self.splits)}")
        return self._views(self.read(split))

    def held_out(self, views: Sequence[Item], every: int, split: str) -> list[Item]:
        """Select the views of a split in a format without splits: every n-th view, from the first, is for val and test.

        This is the convention of LLFF.
        """
        if len(views) < 2:
            raise NerfroError(f"data.root={self.root} holds one image; at least two are needed, for training and test")
        return [view for i, view in enumerate(views) if (i % every == 0) == (split != "train")]

    def _views(self, read: FrameSet) -> Views:
        near, far = read.near if self.near is None else self.near, read.far if self.far is None else self.far
        _check_bounds(near, far)
        frames, files, alpha = read.frames, [frame.image for frame in read.frames], self.alpha
        composited = alpha != "drop"
        images = LazyImages.of(files, lambda path: read_rgb(path, alpha), self.downscale, composited, recipe=alpha)
        (height, width), stored = images.shape, images.size[::-1]
        self._require_own_masks(frames)
        if unused_masks(self.root, files, [*(frame.mask for frame in frames), *read.usable]):
            sets = [self.read(split) for split in self.splits]
            every = [frame for one in sets for frame in one.frames]
            masks_of_all = [*(frame.mask for frame in every), *(mask for one in sets for mask in one.usable)]
            require_used(self.root, [frame.image for frame in every], masks_of_all)
        masks = find_masks(files, [frame.mask for frame in frames], self.downscale, stored, self.mask_labels)
        for frame in frames:
            check_pose(frame.camera_to_world, frame.name, "the pose")
        check_lenses(read.lenses, [frame.name for frame in frames], stored)
        poses = np.stack([frame.camera_to_world for frame in frames])
        poses[:, :, 3] -= self.origin
        self._require_precision(poses[:, :, 3])
        if read.axes == "opencv":
            poses = poses * np.array([1.0, -1.0, -1.0, 1.0])
        intrinsics, distortion = lens_tensors(read.lenses)
        scale = torch.tensor([width / stored[0], height / stored[1]], dtype=torch.float64).repeat(2)
        fx, fy, cx, cy = (intrinsics * scale).float().unbind(-1)
        turntable = read.turntable if self._turntable is None else self._turntable
        cameras = Cameras(
            torch.from_numpy(poses).float(), fx, fy, cx, cy, width, height, near, far, distortion, turntable
        )
        room_rotations(cameras.camera_to_world, turntable)  # refuses cameras without an azimuth
        usable = find_usable(files, read.usable, self.downscale, stored) if any(read.usable) else None
        maps = {DEPTH: read_depths(read.depths, read.depth_unit, cameras)} if any(read.depths) else {}
        if read.points:
            maps[DEPTH] = depths_of_points([points - self.origin for points in read.points], cameras)
        if read.crop < 1:
            window = central_window(height, width, read.crop)
            cameras, images = cameras.crop(window), images.cut(window)
            masks, usable = masks and masks.cut(window), usable and usable.cut(window)
            top, left = window.top, window.left
            maps = {n: m[:, top : top + window.height, left : left + window.width] for n, m in maps.items()}
        return Views(cameras, images, masks, [frame.name for frame in frames], usable, maps, frames, self.mask_labels)

    def _require_precision(self, centres: Float[np.ndarray, "V 3"]) -> None:
        """Refuse cameras that are far from the origin compared with the distances between the cameras."""
        size, spacing = np.ptp(centres, axis=0).max(), float(np.spacing(np.float32(np.abs(centres).max())))
        if spacing > 2e-4 * size > 0:
            middle = centres.mean(0).round(math.ceil(-math.log10(size))) + self.origin
            advice = "subtract this point from all positions of cameras, points and mesh"
            if self.origin.any():
                advice = f"the object lies near {self.origin.tolist()}, so give mesh and cameras the same coordinates"
            raise NerfroError(
                f"the cameras of data.root={self.root} are {size:.3g} world units apart and lie near "
                f"{middle.tolist()}, too far from the origin for single precision; {advice}"
            )

    def _require_own_masks(self, frames: Sequence[Frame]) -> None:
        """Refuse a mask file that belongs to several images of one split or of different splits."""
        for frame in frames:
            image = frame.mask and self._images_of_masks.setdefault(frame.mask, frame.image)
            if image not in (None, frame.image) and frame.mask == find_mask(self.root, frame.image):
                raise NerfroError(
                    f"mask {frame.mask} is found for {image} and for {frame.image}; put masks into the same folders "
                    "below masks/ as the images, or name each mask in the data set (mask_path)"
                )


def turntable_of(where: str, turntable: bool | None, axis: Sequence[float] | None) -> bool | tuple[float, ...] | None:
    """Return `Cameras.turntable` of the settings `turntable` and `turntable_axis`; None if both are left open."""
    if axis is not None and (len(axis) != 3 or not any(axis)):
        raise NerfroError(f"{where}turntable_axis={list(axis)} is no axis; give a direction such as [0,0,1]")
    return turntable if axis is None or turntable is False else tuple(axis)


def _check_bounds(near: float | None, far: float | None) -> None:
    check("data.", dict.fromkeys(("near", "far"), Distance), {"near": near, "far": far})
    if far is not None and (near or 0.0) >= far:
        raise NerfroError(f"data.near={near} and data.far={far} are not an interval; take 0 <= near < far")


def list_images(folder: Path, suffixes: Sequence[str] = VIEW_SUFFIXES) -> list[Path]:
    """List the image files of a folder by name, without masks (`mask_*`) and hidden files.

    Raises:
        NerfroError: the folder does not exist or holds no image.
    """
    if not folder.is_dir():
        raise NerfroError(f"{folder} is not a folder; it should hold the images, see docs/guides/data_formats.md")
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(("mask_", "."))]
    images = [path for path in files if path.suffix.lower() in suffixes]
    if not images:
        others = sorted({path.suffix.lower() for path in files if path.suffix})
        raise NerfroError(
            f"{folder} holds no image{f', but {first_of(others)} files' if others else ''}; allowed are "
            f"{suffix_list(suffixes)}. nerfro.reconstruct also reads HEIC photographs and, with video=FILE, videos"
        )
    return sorted(images)


def require_root(root: Path) -> None:
    """Raise an error if the folder of a data set does not exist, or is a whole file system."""
    refuse_root(root, "data.root")
    if not root.is_dir():
        raise NerfroError(f"data.root={root} is not a folder; give the folder of the data set")


def check_pose(
    matrix: Float[np.ndarray, "rows 4"], where: str, name: str = "transform_matrix"
) -> Float[np.ndarray, "3 4"]:
    """Check that a camera-to-world matrix is a rotation and a translation, and return its first three rows.

    Args:
        matrix: three or four rows.
        where: subject of the error message, such as the file and the frame.
        name: name of the matrix in the file.
    """
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        cause = "it is a reflection" if error <= _ROTATION_TOLERANCE else f"R^T R differs from 1 by {error:.2g}"
        raise NerfroError(
            f"{where}: the 3x3 part of {name} is not a rotation ({cause}); "
            "give camera-to-world matrices without scale or reflection"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise NerfroError(f"{where}: the last row of {name} is {matrix[3].tolist()}; it must be 0, 0, 0, 1")
    check(f"{where}: position in ", {name: list[Coordinate]}, {name: matrix[:3, 3].tolist()})
    return matrix[:3]
