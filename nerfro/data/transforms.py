"""Reading `transforms_<split>.json` files: frames with a pose, an image and perhaps a mask."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.data.cameras import Cameras
from nerfro.data.image_files import Alpha, read_rgb, read_stack
from nerfro.data.masks import find_mask, read_masks
from nerfro.errors import NerfroError

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_SPLIT_ORDER = ("train", "val", "test")
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Frame:
    """One posed image.

    Attributes:
        name: the frame's `file_path`, tidied.
        image: the image's file.
        mask: the mask's file, if there is one.
        camera_to_world: rotation and centre, camera axes as in the file.
    """

    name: str
    image: Path
    mask: Path | None
    camera_to_world: Float[np.ndarray, "3 4"]


@dataclass(frozen=True)
class Manifest:
    """A parsed `transforms_<split>.json`.

    Attributes:
        path: of the file.
        document: its content.
        frames: its frames, at least one, checked.
    """

    path: Path
    document: Mapping[str, object]
    frames: list[Frame]

    def require(self, key: str, meaning: str) -> object:
        """A value of the document.

        Raises:
            NerfroError: it is missing.
        """
        if key not in self.document:
            raise NerfroError(f"{self.path} has no '{key}' ({meaning}); add it")
        return self.document[key]

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the images in pixels, where the file states them (`w` and `h`)."""
        width, height = self.document.get("w"), self.document.get("h")
        if width is None or height is None:
            return None
        if not is_number(width) or not is_number(height):
            raise NerfroError(f"{self.path}: w={width!r} and h={height!r} must be numbers of pixels")
        return int(width), int(height)


def find_splits(root: Path) -> dict[str, Path]:
    """The transforms files of a folder by split; both `transforms_train.json` and `train_transforms.json` are found.

    Raises:
        NerfroError: the folder does not exist or holds none.
    """
    if not root.is_dir():
        raise NerfroError(f"data.root={root} is not a folder; give the one that holds transforms_train.json")
    found = {path.stem.removesuffix("_transforms"): path for path in root.glob("*_transforms.json")}
    found |= {path.stem.removeprefix("transforms_"): path for path in root.glob("transforms_*.json")}
    if not found:
        raise NerfroError(
            f"data.root={root} holds no transforms_<split>.json; give a folder that does, see docs/data.md"
        )
    rank = {name: i for i, name in enumerate(_SPLIT_ORDER)}
    return {name: found[name] for name in sorted(found, key=lambda name: (rank.get(name, len(rank)), name))}


def read_manifest(root: Path, split: str) -> Manifest:
    """Read and check the transforms file of a split.

    Raises:
        NerfroError: there is no such split; the file is truncated or lacks a key; a frame has no image, a bad pose or
            another frame's name.
    """
    splits = find_splits(root)
    if split not in splits:
        raise NerfroError(f"data.root={root} has no split '{split}'; it has {', '.join(splits)}")
    path = splits[split]
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise NerfroError(f"{path} is not valid JSON ({error}): truncated? copy or export it again") from error
    except OSError as error:
        raise NerfroError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list):
        raise NerfroError(f"{path} has no list 'frames'; see docs/data.md for the format")
    if not frames:
        raise NerfroError(f"{path} has an empty list 'frames'; a split needs at least one")
    manifest = Manifest(path, document, [_read_frame(path, i, frame) for i, frame in enumerate(frames)])
    _check_names(manifest)
    return manifest


def read_images(
    manifest: Manifest, downscale: int, alpha: Alpha
) -> tuple[Float[Tensor, "V H W 3"], Float[Tensor, "V H W"] | None]:
    """Read the frames' images, and their masks if they have any.

    Args:
        manifest: the frames.
        downscale: side of the blocks of pixels that are averaged.
        alpha: what becomes of transparency, see `read_rgb`.

    Returns:
        Colours, sRGB in [0, 1], and shares of each pixel that the object covers.

    Raises:
        NerfroError: an image or mask is missing, corrupt or of the wrong size, or `downscale` does not divide it.
    """
    images = read_stack(
        [frame.image for frame in manifest.frames], lambda path: read_rgb(path, alpha), downscale, manifest.size
    )
    size = images.shape[2] * downscale, images.shape[1] * downscale
    frames = manifest.frames
    return images, read_masks([frame.image for frame in frames], [frame.mask for frame in frames], downscale, size)


def make_cameras(
    manifest: Manifest,
    axes: Literal["opengl", "opencv"],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    near: float,
    far: float,
) -> Cameras:
    """Cameras of the frames.

    Args:
        manifest: the frames.
        axes: the camera axes of their poses: `opengl` (x right, y up, looks along -z) or `opencv` (y down, along +z).
        intrinsics: fx, fy, cx, cy in pixels, the same for all frames.
        size: width and height in pixels.
        near, far: bounds of the rays in arc length.
    """
    poses = np.stack([frame.camera_to_world for frame in manifest.frames])
    if axes == "opencv":
        poses = poses * np.array([1.0, -1.0, -1.0, 1.0])
    num_views = len(manifest.frames)
    fx, fy, cx, cy = (torch.full((num_views,), float(value)) for value in intrinsics)
    return Cameras(torch.from_numpy(poses).float(), fx, fy, cx, cy, *size, near, far)


def check_options(near: float, far: float, downscale: int) -> None:
    """Check the options that all loaders share.

    Raises:
        NerfroError: one is out of range.
    """
    if not 0 <= near < far < math.inf:  # also false for NaN
        raise NerfroError(f"data.near={near} and data.far={far} are no interval; take 0 <= near < far")
    if downscale < 1:
        raise NerfroError(f"data.downscale={downscale} is not allowed; take 1 for full size, 2 for half, and so on")


def parse_matrix(value: object, shapes: tuple[tuple[int, int], ...], where: str) -> Float[np.ndarray, "rows columns"]:
    """A matrix of finite numbers.

    Raises:
        NerfroError: it is not one, or has none of the shapes.
    """
    allowed = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise NerfroError(f"{where} is not a matrix of numbers; give {allowed} numbers") from error
    if matrix.shape not in shapes:
        raise NerfroError(
            f"{where} has shape {'x'.join(map(str, matrix.shape)) or 'of a number'}; give {allowed} numbers"
        )
    if not np.isfinite(matrix).all():
        raise NerfroError(f"{where} holds NaN or infinite numbers; correct it or take the frame out")
    return matrix


def is_number(value: object) -> TypeGuard[float]:
    """Whether a JSON value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _read_frame(path: Path, index: int, entry: object) -> Frame:
    where = f"{path}: frame {index}"
    if not isinstance(entry, dict):
        raise NerfroError(f"{where} is not an object; see docs/data.md for the format")
    for key in ("file_path", "transform_matrix"):
        if key not in entry:
            raise NerfroError(f"{where} has no '{key}'; add it or take the frame out")
    if not isinstance(entry["file_path"], str) or not isinstance(entry.get("mask_path", ""), str):
        raise NerfroError(f"{where}: 'file_path' and 'mask_path' must be text")
    name = PurePosixPath(entry["file_path"].replace("\\", "/")).as_posix()
    where += f" ('{name}')"
    pose = _check_pose(parse_matrix(entry["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix"), where)
    image = _find_image(path.parent, name, where)
    return Frame(name, image, find_mask(path.parent, image, entry.get("mask_path")), pose)


def _find_image(root: Path, name: str, where: str) -> Path:
    """The image file of a `file_path` with or without extension."""
    if PurePosixPath(name).suffix.lower() in _IMAGE_SUFFIXES:
        candidates = [root / name]
    else:
        candidates = [root / f"{name}{suffix}" for suffix in _IMAGE_SUFFIXES]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise NerfroError(f"{where}: image {candidates[0]} does not exist; restore it or take the frame out")


def _check_pose(matrix: Float[np.ndarray, "rows 4"], where: str) -> Float[np.ndarray, "3 4"]:
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        cause = "mirrors" if error <= _ROTATION_TOLERANCE else f"is off by {error:.2g}"
        raise NerfroError(
            f"{where}: the 3x3 part of transform_matrix is no rotation (it {cause}); "
            "give camera-to-world matrices without scale or reflection"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise NerfroError(f"{where}: the last row of transform_matrix is {matrix[3].tolist()}; it must be 0, 0, 0, 1")
    return matrix[:3]


def _check_names(manifest: Manifest) -> None:
    # By file: `r_0` and `r_0.png` are one image.
    counts = Counter(frame.image for frame in manifest.frames)
    repeated = list(dict.fromkeys(frame.name for frame in manifest.frames if counts[frame.image] > 1))
    if repeated:
        raise NerfroError(f"{manifest.path}: {_listing(repeated)} occurs in several frames; keep one of each")


def _listing(names: list[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
