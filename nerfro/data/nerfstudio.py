"""Data format of nerfstudio."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from nerfro.allowed import Distance, Factor
from nerfro.data.bounds import find_bounds
from nerfro.data.frames import SPLITS, Every, FrameSet, Lens, PosedImages
from nerfro.data.image_files import Alpha, read_size
from nerfro.data.masks import find_mask
from nerfro.data.transforms import Manifest, find_splits, is_number, parse_manifest, read_manifest
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import load_points
from nerfro.lens import coefficients
from nerfro.registry import register

_SINGLE, _MASK_KEY = "transforms.json", "object_mask_path"

# Supported values of `camera_model`. These models differ only in the coefficients that are zero.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")


@register("data", "nerfstudio")
class NerfstudioData(PosedImages):
    """Read the format of nerfstudio: transforms.json, or one file per split, with intrinsics and distortion.

    Poses have OpenGL camera axes and keep the world of the file. nerfstudio rotates, centres and scales the world for
    training; here the world stays unchanged so that a mesh of the object fits. `mask_path` marks pixels to ignore
    (black), which are not used for training. The silhouette of the refractive object is `object_mask_path`.

    Args:
        root, near, far, downscale, alpha: see `PosedImages`. Without `near` and `far`, the bounds are estimated from
            the sparse points (`ply_file_path`) or from the cameras; see `find_bounds`.
        missing: whether to `skip` frames whose image does not exist, with a warning, or to `refuse` the data set.
        test_every: every n-th frame by name, from the first, belongs to val and test, unless the file has the lists
            {train,val,test}_filenames.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
        missing: Literal["skip", "refuse"] = "skip",
        test_every: Every = 10,
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)
        self.skip_missing, self.test_every = missing == "skip", test_every

    @property
    def splits(self) -> list[str]:
        return SPLITS if self._is_single else list(find_splits(self.root))

    @property
    def _is_single(self) -> bool:
        return (self.root / _SINGLE).is_file()

    def _manifest(self, split: str) -> Manifest:
        return self._whole if self._is_single else read_manifest(self.root, split, _MASK_KEY, self.skip_missing)

    @functools.cached_property
    def _whole(self) -> Manifest:
        return parse_manifest(self.root / _SINGLE, _MASK_KEY, self.skip_missing)

    def read(self, split: str) -> FrameSet:
        manifest = self._manifest(split)
        chosen = self._choose(manifest, split) if self._is_single else list(range(len(manifest.frames)))
        entries: list[Mapping[str, object]] = manifest.document["frames"]  # type: ignore[assignment]
        frames = [manifest.frames[i] for i in chosen]
        width, height, _ = read_size(frames[0].image)
        lenses, usable = [], []
        for entry, frame in zip([entries[i] for i in chosen], frames, strict=True):
            where = f"{manifest.path}: '{frame.name}'"
            lenses.append(read_lens({**manifest.document, **entry}, width, height, where))
            path = entry.get("mask_path")
            if not isinstance(path, str | None):
                raise NerfroError(f"{where}: 'mask_path' must be text; it is {path!r}")
            usable.append(None if path is None else find_mask(self.root, frame.image, path))
        return FrameSet(frames, lenses, "opengl", *self._bounds(split), usable=usable)

    def _bounds(self, split: str) -> tuple[float, float]:
        """Return the bounds, which are estimated from the training cameras for all splits."""
        if self.near is not None and self.far is not None:
            return self.near, self.far
        manifest = self._manifest("train" if "train" in self.splits else split)
        points, file = np.empty((0, 3)), manifest.document.get("ply_file_path")
        if isinstance(file, str) and (self.root / file).is_file():
            points = load_points(self.root / file)
        return find_bounds(np.stack([frame.camera_to_world for frame in manifest.frames]), points)

    def _choose(self, manifest: Manifest, split: str) -> list[int]:
        """Return the indices of the frames of a split."""
        listed = {name: manifest.document.get(f"{name}_filenames") for name in SPLITS}
        by_name = sorted(range(len(manifest.frames)), key=lambda i: manifest.frames[i].name)
        if not any(listed.values()):
            return self.held_out(by_name, self.test_every, split)
        names = listed[split]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise NerfroError(
                f"{manifest.path} lists the files of other splits but has no '{split}_filenames'; "
                "add it, or remove all lists"
            )
        known = {manifest.frames[i].name: i for i in by_name}
        names = [PurePosixPath(name.replace("\\", "/")).as_posix() for name in names]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise NerfroError(f"{manifest.path}: {split}_filenames lists '{unknown[0]}', but no frame has this name")
        return [known[name] for name in names]


def read_lens(values: Mapping[str, object], width: int, height: int, where: str) -> Lens:
    """Read the intrinsics of a frame.

    Args:
        values: keys of the frame, merged over the keys of the file.
        width, height: stored size of the image in pixels.
        where: subject of the error message.
    """
    model = values.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE:
        raise NerfroError(
            f"{where}: camera_model={model!r} is not supported; undistort the images to one of "
            f"{', '.join(_PERSPECTIVE)}, for example with COLMAP's image_undistorter"
        )
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_angle_x"):
        if key in values and not is_number(values[key]):
            raise NerfroError(f"{where}: {key}={values[key]!r} must be a number")
    numbers = {key: float(value) for key, value in values.items() if is_number(value)}
    calibrated = numbers.get("w", width), numbers.get("h", height)
    if "fl_x" in numbers:
        fx = numbers["fl_x"]
    elif 0 < numbers.get("camera_angle_x", 0) < math.pi:
        fx = 0.5 * calibrated[0] / math.tan(0.5 * numbers["camera_angle_x"])
    else:
        raise NerfroError(f"{where} has neither 'fl_x' nor a valid 'camera_angle_x'; add the focal length in pixels")
    fy = numbers.get("fl_y", fx)
    if fx <= 0 or fy <= 0 or min(calibrated) <= 0:
        raise NerfroError(f"{where}: fl_x={fx:g}, fl_y={fy:g}, w and h must be positive")
    k1, k2, k3, k4, p1, p2 = (numbers.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    centre = numbers.get("cx", 0.5 * calibrated[0]), numbers.get("cy", 0.5 * calibrated[1])
    lens = Lens(fx, fy, *centre, coefficients([k1, k2, k3, k4], [p1, p2]))
    return lens.resized(calibrated, (width, height), where)
