"""Data in nerfstudio's format."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Views
from nerfro.data.bounds import find_bounds
from nerfro.data.frames import SPLITS, Every, Lens, PosedImages, held_out
from nerfro.data.image_files import Alpha, read_size
from nerfro.data.masks import find_mask, find_usable
from nerfro.data.transforms import Manifest, find_splits, is_number, parse_manifest, read_manifest
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import load_points
from nerfro.lens import coefficients
from nerfro.registry import register

_SINGLE, _MASK_KEY = "transforms.json", "object_mask_path"

# What `camera_model` may say for a perspective lens; they differ in which coefficients are zero.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")


@register("data", "nerfstudio")
class NerfstudioData(PosedImages):
    """Folder with transforms.json (or transforms_{train,val,test}.json): OpenGL axes, intrinsics with distortion.

    Poses are taken as they are: the world is that of the file, not turned, centred and scaled as nerfstudio does when
    it trains, so that a mesh fits. `mask_path` in these files marks pixels to ignore (black), which are not
    trained on; a frame's silhouette of the refractive object is its `object_mask_path`.

    Args:
        root, near, far, downscale, alpha: see `PosedImages`; bounds that are none hold the file's sparse points
            (`ply_file_path`) in view, or, where it has none, what the cameras look at: see `find_bounds`.
        missing: whether frames whose image does not exist are left out with a warning (`skip`) or refused.
        test_every: every such frame by name, from the first, is for val and test, where the file has no
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

    def load(self, split: str) -> Views:
        self.require(split)
        manifest = self._manifest(split)
        chosen = self._choose(manifest, split) if self._is_single else list(range(len(manifest.frames)))
        entries: list[Mapping[str, object]] = manifest.document["frames"]  # type: ignore[assignment]
        names = [f"{manifest.path}: '{manifest.frames[i].name}'" for i in chosen]

        def lenses(width: int, height: int) -> list[Lens]:
            values = [{**manifest.document, **entries[i]} for i in chosen]
            return [read_lens(v, width, height, name) for v, name in zip(values, names, strict=True)]

        frames = [manifest.frames[i] for i in chosen]
        ignoring: list[Path | None] = []
        for i, frame, name in zip(chosen, frames, names, strict=True):
            stated = entries[i].get("mask_path")
            if stated is not None and not isinstance(stated, str):
                raise NerfroError(f"{name}: 'mask_path' must be text")
            ignoring.append(None if stated is None else find_mask(self.root, frame.image, stated))
        views = self.views(frames, lenses, "opengl", *self._bounds(split))
        if not any(ignoring):
            return views
        files, stored = [frame.image for frame in frames], read_size(frames[0].image)[:2]
        return replace(views, usable=find_usable(files, ignoring, self.downscale, stored))

    def _bounds(self, split: str) -> tuple[float, float]:
        """Near and far where they are not given, of the training cameras for all splits."""
        if self.near is not None and self.far is not None:
            return self.near, self.far
        manifest = self._manifest("train" if "train" in self.splits else split)
        points, file = np.empty((0, 3)), manifest.document.get("ply_file_path")
        if isinstance(file, str) and (self.root / file).is_file():
            points = load_points(self.root / file)
        return find_bounds(np.stack([frame.camera_to_world for frame in manifest.frames]), points)

    def _choose(self, manifest: Manifest, split: str) -> list[int]:
        """Numbers of the frames of a split."""
        listed = {name: manifest.document.get(f"{name}_filenames") for name in SPLITS}
        by_name = sorted(range(len(manifest.frames)), key=lambda i: manifest.frames[i].name)
        if not any(listed.values()):
            return [by_name[i] for i in held_out(len(by_name), self.test_every, split, self.root)]
        names = listed[split]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise NerfroError(
                f"{manifest.path} lists other splits' files but no '{split}_filenames'; add it, or take all lists out"
            )
        known = {manifest.frames[i].name: i for i in by_name}
        tidy = [PurePosixPath(name.replace("\\", "/")).as_posix() for name in names]
        unknown = [name for name in tidy if name not in known]
        if unknown:
            raise NerfroError(f"{manifest.path}: {split}_filenames names '{unknown[0]}', which is no frame; correct it")
        return [known[name] for name in tidy]


def read_lens(values: Mapping[str, object], width: int, height: int, where: str) -> Lens:
    """The lens of a frame from its own keys, and the file's where it has none."""
    model = values.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE:
        raise NerfroError(
            f"{where}: camera_model={model!r} is not supported; undistort the images to a perspective one "
            f"({', '.join(_PERSPECTIVE)}), for example with COLMAP's image_undistorter"
        )
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_angle_x"):
        if key in values and not is_number(values[key]):
            raise NerfroError(f"{where}: {key}={values[key]!r} must be a number")
    numbers = {key: float(value) for key, value in values.items() if is_number(value)}
    made_for = numbers.get("w", width), numbers.get("h", height)
    if "fl_x" in numbers:
        fx = numbers["fl_x"]
    elif 0 < numbers.get("camera_angle_x", 0) < math.pi:
        fx = 0.5 * made_for[0] / math.tan(0.5 * numbers["camera_angle_x"])
    else:
        raise NerfroError(f"{where} has neither 'fl_x' nor a valid 'camera_angle_x'; add the focal length in pixels")
    fy = numbers.get("fl_y", fx)
    if fx <= 0 or fy <= 0 or min(made_for) <= 0:
        raise NerfroError(f"{where}: fl_x={fx:g}, fl_y={fy:g}, w and h must be positive")
    k1, k2, k3, k4, p1, p2 = (numbers.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    centre = numbers.get("cx", 0.5 * made_for[0]), numbers.get("cy", 0.5 * made_for[1])
    lens = Lens(fx, fy, *centre, coefficients([k1, k2, k3, k4], [p1, p2]))
    return lens.resized(made_for, (width, height), where)
