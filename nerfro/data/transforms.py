"""Reader of `transforms_<split>.json` files, which list images with poses and optional masks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeGuard

import numpy as np
from jaxtyping import Float

from nerfro.cli import warn
from nerfro.data.base import Frame
from nerfro.data.frames import SPLITS, check_pose, require_root
from nerfro.data.image_files import IMAGE_SUFFIXES
from nerfro.data.masks import find_mask
from nerfro.errors import NerfroError, first_of
from nerfro.files.reading import read_json


@dataclass(frozen=True)
class Manifest:
    """A parsed `transforms_<split>.json`.

    Attributes:
        path: the file.
        document: content of the file.
        frames: checked frames, at least one.
    """

    path: Path
    document: Mapping[str, object]
    frames: list[Frame]

    def require(self, key: str, meaning: str) -> object:
        """Return a required value; `meaning` explains the key in the error message."""
        if key not in self.document:
            raise NerfroError(f"{self.path} has no '{key}' ({meaning}); add it")
        return self.document[key]

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the images in pixels (`w` and `h`), or None if the file does not state both."""
        width, height = self.document.get("w"), self.document.get("h")
        if width is None or height is None:
            return None
        if not is_number(width) or not is_number(height):
            raise NerfroError(f"{self.path}: w={width!r} and h={height!r} must be numbers of pixels")
        return int(width), int(height)


def find_splits(root: Path) -> dict[str, Path]:
    """Find the transforms files of a folder by split: `transforms_train.json` or `train_transforms.json`.

    Returns:
        At least one file; train, val and test come first.
    """
    require_root(root)
    found = {path.stem.removesuffix("_transforms"): path for path in root.glob("*_transforms.json")}
    found |= {path.stem.removeprefix("transforms_"): path for path in root.glob("transforms_*.json")}
    if not found:
        raise NerfroError(
            f"data.root={root} holds no transforms_<split>.json; give the folder of a data set, see docs/data.md"
        )
    rank = {name: i for i, name in enumerate(SPLITS)}
    return {name: found[name] for name in sorted(found, key=lambda name: (rank.get(name, len(rank)), name))}


def read_manifest(root: Path, split: str, mask_key: str = "mask_path", skip_missing: bool = False) -> Manifest:
    """Read and check the transforms file of an existing split; see `parse_manifest`."""
    return parse_manifest(find_splits(root)[split], mask_key, skip_missing)


def parse_manifest(path: Path, mask_key: str = "mask_path", skip_missing: bool = False) -> Manifest:
    """Read and check a transforms file.

    Args:
        path: the file.
        mask_key: key of a frame's silhouette. With the default key, silhouettes are also searched beside the images.
        skip_missing: skip frames whose image does not exist, with one warning.

    Raises:
        NerfroError: the file is truncated or lacks a key, or a frame has no image, an invalid pose or a repeated name.
    """
    document = read_json(path, "check its permissions")
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list):
        raise NerfroError(f"{path} has no list 'frames'; see docs/data.md for the format")
    if not frames:
        raise NerfroError(f"{path} has an empty list 'frames'; a split needs at least one")
    if skip_missing:
        frames = _with_images(path, frames)
        document = {**document, "frames": frames}
    read = [_read_frame(path, i, frame, mask_key) for i, frame in enumerate(frames)]
    counts = Counter(frame.image for frame in read)  # by file: `r_0` and `r_0.png` are one image
    repeated = list(dict.fromkeys(f"'{frame.name}'" for frame in read if counts[frame.image] > 1))
    if repeated:
        raise NerfroError(f"{path}: {first_of(repeated)} occurs in several frames; keep one frame per image")
    return Manifest(path, document, read)


def parse_matrix(value: object, shapes: tuple[tuple[int, int], ...], where: str) -> Float[np.ndarray, "rows columns"]:
    """Convert nested lists to a matrix of finite numbers that has one of the shapes."""
    allowed = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        matrix = np.array(value)
    except ValueError:  # rows of different lengths
        matrix = np.empty(0, object)
    if matrix.dtype.kind not in "fiu":
        raise NerfroError(f"{where} is not a matrix of numbers; give {allowed} numbers")
    matrix = matrix.astype(np.float64)
    if matrix.shape not in shapes:
        raise NerfroError(
            f"{where} has shape {'x'.join(map(str, matrix.shape)) or 'of a number'}; give {allowed} numbers"
        )
    if not np.isfinite(matrix).all():
        raise NerfroError(f"{where} holds NaN or infinite numbers; correct it or take the frame out")
    return matrix


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a JSON value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _with_images(path: Path, frames: list) -> list:
    """Drop the frames whose image does not exist, with a warning. Other errors are reported by `_read_frame`."""
    names = [frame.get("file_path") if isinstance(frame, dict) else None for frame in frames]
    missing = [isinstance(name, str) and _existing_image(path.parent, name) is None for name in names]
    if all(missing) or not any(missing):
        return frames
    skipped = first_of([str(name) for name, gone in zip(names, missing, strict=True) if gone])
    warn(f"{path}: {sum(missing)} of {len(frames)} frames have no image and are skipped: {skipped}")
    return [frame for frame, gone in zip(frames, missing, strict=True) if not gone]


def _read_frame(path: Path, index: int, entry: object, mask_key: str) -> Frame:
    where = f"{path}: frame {index}"
    if not isinstance(entry, dict):
        raise NerfroError(f"{where} is not an object; see docs/data.md for the format")
    for key in ("file_path", "transform_matrix"):
        if key not in entry:
            raise NerfroError(f"{where} has no '{key}'; add it or take the frame out")
    # `mask_file_path` is RefRef's key for the silhouette.
    stated = entry.get(mask_key, entry.get("mask_file_path"))
    if not isinstance(entry["file_path"], str) or not isinstance(stated, str | None):
        raise NerfroError(f"{where}: 'file_path' and '{mask_key}' must be text")
    name = PurePosixPath(entry["file_path"].replace("\\", "/")).as_posix()
    where += f" ('{name}')"
    pose = check_pose(parse_matrix(entry["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix"), where)
    image = _existing_image(path.parent, name)
    if image is None:
        missing = _candidates(path.parent, name)[0]
        raise NerfroError(f"{where}: image {missing} does not exist; restore it or take the frame out")
    has_mask = mask_key == "mask_path" or stated is not None
    return Frame(name, image, find_mask(path.parent, image, stated) if has_mask else None, pose)


def _candidates(root: Path, name: str) -> list[Path]:
    """List the possible image files of a `file_path`, which may lack its extension."""
    name = name.replace("\\", "/")
    known = PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES
    return [root / name] if known else [root / f"{name}{suffix}" for suffix in IMAGE_SUFFIXES]


def _existing_image(root: Path, name: str) -> Path | None:
    return next((path for path in _candidates(root, name) if path.is_file()), None)
