"""Reader of `transforms_<split>.json` files, which list images with poses and optional masks."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.data.base import SPLITS, Frame
from nerfro.data.frames import check_pose, require_root, turntable_of
from nerfro.data.image_files import VIEW_SUFFIXES, read_size, suffix_list
from nerfro.data.lenses import Lens, read_lens
from nerfro.data.masks import find_mask, mask_beside
from nerfro.files.reading import parse_matrix, read_json, unicode_forms
from nerfro.registry.allowed import check

_OTHER_TYPES = (".heic", ".heif", ".avif", ".npy")  # of photographs that are not read
# Files and folders of other data formats, for a message.
_OTHER_FORMATS = {
    "transforms.json": "nerfstudio", "sparse": "colmap", "colmap": "colmap", "poses_bounds.npy": "llff",
    "cameras_sphere.npz": "idr",
}  # fmt: skip
_TURNTABLE: dict[str, Any] = {"turntable": bool, "turntable_axis": list[float]}
_PATHS = dict.fromkeys(("file_path", "mask_path", "mask_file_path", "object_mask_path"), str)


@dataclass(frozen=True)
class Manifest:
    """A parsed `transforms_<split>.json`.

    Attributes:
        path: the file.
        document: content of the file.
        frames: checked frames, at least one.
        skipped: names of the frames whose image does not exist.
    """

    path: Path
    document: Mapping[str, object]
    frames: list[Frame]
    skipped: Sequence[str] = ()

    def number(self, key: str, default: float) -> float:
        """Return a number of the file, which may lack the key."""
        value: Any = self.document.get(key)
        check(f"{self.path}: ", {key: float}, {key: value})
        return default if value is None else value

    @property
    def turntable(self) -> bool | tuple[float, ...]:
        """Value of the keys `turntable` and `turntable_axis` of the file, see `PosedImages`; false without them."""
        values: dict[str, Any] = {key: self.document.get(key) for key in _TURNTABLE}
        check(f"{self.path}: ", _TURNTABLE, values)
        return turntable_of(f"{self.path}: ", *values.values()) or False

    def lenses(self, indices: Sequence[int] | None = None) -> list[Lens]:
        """Read the lenses of all frames, or of those at `indices`, for the size of their images; see `read_lens`."""
        entries: Any = self.document["frames"]
        indices = range(len(self.frames)) if indices is None else indices
        size = read_size(self.frames[indices[0]].image)[:2]
        where = (f"{self.path}: '{self.frames[i].name}'" for i in indices)
        return [read_lens(self.document, entries[i], size, name) for i, name in zip(indices, where, strict=True)]


def find_splits(root: Path) -> dict[str, Path]:
    """Find the transforms files of a folder by split: `transforms_train.json` or `train_transforms.json`.

    Returns:
        At least one file; train, val and test come first.
    """
    require_root(root)
    files = {path.stem.removesuffix("_transforms"): path for path in root.glob("*_transforms.json")}
    files |= {path.stem.removeprefix("transforms_"): path for path in root.glob("transforms_*.json")}
    if not files:
        names = [f"{name}, which data={form} reads" for name, form in _OTHER_FORMATS.items() if (root / name).exists()]
        advice = f"it holds {names[0]}" if names else "give the folder of a data set, see docs/guides/data_formats.md"
        raise NerfroError(f"data.root={root} holds no transforms_<split>.json; {advice}")
    rank = {name: i for i, name in enumerate(SPLITS)}
    return {name: files[name] for name in sorted(files, key=lambda name: (rank.get(name, len(rank)), name))}


def read_manifest(root: Path, split: str, mask_key: str = "mask_path", skip_missing: bool = False) -> Manifest:
    """Read and check the transforms file of an existing split, which states the same turntable as the other splits.

    See `parse_manifest`.
    """
    splits = find_splits(root)
    manifest = parse_manifest(splits.pop(split), mask_key, skip_missing)
    stated = [manifest.document.get(key) for key in _TURNTABLE]
    for other in splits.values():
        document: Any = read_json(other, "check its permissions")
        if isinstance(document, dict) and [document.get(key) for key in _TURNTABLE] != stated:
            raise NerfroError(
                f"{manifest.path} and {other} have other values of {' or '.join(_TURNTABLE)}; make them equal"
            )
    return manifest


def parse_manifest(path: Path, mask_key: str = "mask_path", skip_missing: bool = False) -> Manifest:
    """Read and check a transforms file.

    Args:
        path: the file.
        mask_key: key of a frame's silhouette. Without this key, the silhouette is searched as `find_mask` does. With
            another key than the default, it is only searched beside the image, and `mask_path` is no silhouette.
        skip_missing: skip frames whose image does not exist, with one warning.

    Raises:
        NerfroError: the file is truncated or lacks a key, or a frame has no image, an invalid pose or a repeated name.
    """
    document = read_json(path, "check its permissions")
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list):
        raise NerfroError(f"{path} has no list 'frames'; see docs/guides/data_formats.md for the format")
    if not frames:
        raise NerfroError(f"{path} has an empty list 'frames'; a split needs at least one")
    names = [_frame_name(f"{path}: frame {i}", frame) for i, frame in enumerate(frames)]
    image_of = {name: existing_image(path.parent, name) for name in dict.fromkeys(names)}
    images = [image_of[name] for name in names]
    for name, image in image_of.items():
        if image is None:
            _refuse_other_type(path, name)
    counts = Counter(image for image in images if image is not None)  # by file: `r_0` and `r_0.png` are one image
    repeated = {f"'{name}'": None for name, image in zip(names, images, strict=True) if image and counts[image] > 1}
    if repeated:
        raise NerfroError(f"{path}: {first_of(list(repeated))} occurs in several frames; keep one frame per image")
    kept = list(range(len(frames)))
    missing, skipped = [names[i] for i in kept if images[i] is None], []
    if skip_missing and 0 < len(missing) < len(frames):
        warn(f"{path}: {len(missing)} of {len(frames)} frames have no image and are skipped: {first_of(missing)}")
        skipped = missing
        kept = [i for i in kept if images[i] is not None]
    read = [
        _read_frame(f"{path}: frame {i} ('{names[i]}')", frames[i], names[i], images[i], path.parent, mask_key)
        for i in kept
    ]
    return Manifest(path, document | {"frames": [frames[i] for i in kept]}, read, skipped)


def _frame_name(where: str, entry: object) -> str:
    """Check the types in one entry of `frames`, and return the path of its image."""
    if not isinstance(entry, dict):
        raise NerfroError(f"{where} is not an object; see docs/guides/data_formats.md for the format")
    for key in ("file_path", "transform_matrix"):
        if entry.get(key) is None:
            raise NerfroError(f"{where} has no '{key}'; add it or take the frame out")
    for key in ("transform_matrix_start", "transform_matrix_end"):
        if entry.get(key) not in (None, entry["transform_matrix"]):
            raise NerfroError(f"{where}: {key} says that the camera moves during the exposure; take the frame out")
    check(f"{where}: ", _PATHS, {key: entry.get(key) for key in _PATHS})
    return PurePosixPath(entry["file_path"].replace("\\", "/")).as_posix()


def _read_frame(
    where: str, entry: Mapping[str, Any], name: str, image: Path | None, root: Path, mask_key: str
) -> Frame:
    pose = check_pose(parse_matrix(entry["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix"), where)
    if image is None:
        file = root / name if PurePosixPath(name).suffix else _candidates(root, name)[0]
        raise NerfroError(f"{where}: image {file} does not exist; restore it or take the frame out")
    # `mask_file_path` is RefRef's key for the silhouette.
    stated = entry.get(mask_key, entry.get("mask_file_path"))
    if mask_key == "mask_path" or stated is not None:
        return Frame(name, image, find_mask(root, image, stated), pose)
    beside, ignored = mask_beside(image), root / (entry.get("mask_path") or "").replace("\\", "/")
    is_ignored = beside is not None and os.path.abspath(beside) == os.path.abspath(ignored)
    return Frame(name, image, None if is_ignored else beside, pose)


def _refuse_other_type(path: Path, name: str) -> None:
    """Refuse an image that a transforms file names and that exists in a format that is not read."""
    suffixes = ("", *_OTHER_TYPES, *(suffix.upper() for suffix in _OTHER_TYPES))
    file = next((file for end in suffixes if os.path.isfile(file := path.parent / f"{name}{end}")), None)
    if file is not None:
        raise NerfroError(
            f"{path} names {file}, and images with the ending {file.suffix or '(none)'} are not read; convert the "
            "images to PNG (8 or 16 bits, sRGB) or JPEG, and correct the names in the file. Allowed are "
            f"{suffix_list(VIEW_SUFFIXES)}"
        )


def _candidates(root: Path, name: str) -> list[Path]:
    """List the possible image files of a `file_path` with a missing extension, or with one in upper or lower case."""
    suffix = PurePosixPath(name).suffix
    suffixes: tuple[str, ...] = VIEW_SUFFIXES
    if suffix.lower() in VIEW_SUFFIXES:
        name, suffixes = name.removesuffix(suffix), (suffix, suffix.lower())
    return [root / f"{name}{end}" for end in (*suffixes, *(end.upper() for end in suffixes))]


def existing_image(root: Path, name: str) -> Path | None:
    """Find the image file of a `file_path`, whose extension may be missing; None if there is no such file."""
    # Unlike Path.is_file, this function returns False for a name that is too long.
    candidates = (path for form in unicode_forms(name) for path in _candidates(root, form))
    return next((path for path in candidates if os.path.isfile(path)), None)
