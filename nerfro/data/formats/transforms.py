"""Data formats with transforms files: the scenes of NeRF (Blender), the captures of the paper, and nerfstudio."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Gt, Le

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, warn
from nerfro.data.base import SPLITS
from nerfro.data.frames import Every, FrameSet, PosedImages, find_bounds, image_edges, usable_points
from nerfro.data.image_files import read_size
from nerfro.data.masks import find_mask
from nerfro.data.transforms import Manifest, find_splits, parse_manifest, read_manifest
from nerfro.files.reading import same_content
from nerfro.geometry.mesh import load_points
from nerfro.registry.allowed import Distance, Positive, check
from nerfro.registry.registration import register


@register("data", "blender")
class BlenderData(PosedImages):
    """Read the Blender format of the synthetic NeRF scenes: `transforms_{train,val,test}.json`.

    Poses have OpenGL camera axes; `read_lens` describes the keys of the lens. `embedded:torus` is the scene that is
    distributed with nerfro. `PosedImages` describes the options.
    """

    def __init__(self, root: str = "embedded:torus", near: Distance = 2.0, far: Distance = 6.0, **options: Any) -> None:
        super().__init__(root, near, far, **options)

    def split_files(self) -> Mapping[str, Path]:
        return find_splits(self.root)

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        return FrameSet(manifest.frames, manifest.lenses(), "opengl", turntable=manifest.turntable)


@register("data", "opencv")
class OpenCVData(PosedImages):
    """Read the format of the paper's captured scenes: `transforms_{train,val,test}.json` with one 3x3 camera matrix.

    Poses have OpenCV camera axes. The centre of pixel (column, row) is at (column + 0.5, row + 0.5), as in the code of
    the paper's authors.

    Args:
        near, far: bounds of the rays, arc lengths in world units; by default `near` and `far` of the file, or 0.2 and
            12.
        options: see `PosedImages`.
        eval_crop: fraction of each side that is kept around the centre, for the images of every split except train.
    """

    def __init__(
        self,
        root: str,
        near: Distance | None = None,
        far: Distance | None = None,
        eval_crop: Annotated[float, Gt(0), Le(1)] = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(root, near, far, **options)
        self.eval_crop = eval_crop

    def split_files(self) -> Mapping[str, Path]:
        return find_splits(self.root)

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        crop = 1.0 if split == "train" else self.eval_crop
        near, far = (manifest.number(name, default) for name, default in (("near", 0.2), ("far", 12.0)))
        return FrameSet(manifest.frames, manifest.lenses(), "opencv", near, far, crop, turntable=manifest.turntable)


_MASK_KEY = "object_mask_path"


@register("data", "nerfstudio")
class NerfstudioData(PosedImages):
    """Read the format of nerfstudio: transforms.json, or one file per split, with intrinsics and distortion.

    Poses have OpenGL camera axes and keep the world of the file. nerfstudio rotates, centres and scales the world for
    training; here the world stays unchanged so that a mesh of the object fits. `mask_path` marks pixels to ignore
    (black), which are not used for training. The silhouette of the refractive object is `object_mask_path`.

    Args:
        near, far: bounds of the rays, arc lengths in world units; by default estimated from the sparse points
            (`ply_file_path`) or from the cameras, see `find_bounds`.
        options: see `PosedImages`.
        missing: whether to `skip` frames whose image does not exist, with a warning, or to `refuse` the data set.
        depth_unit: world units per level of the depth images (`depth_file_path`), such as 0.001 for millimetres; None
            to read no depths.
        test_every: every n-th frame by name, from the first, belongs to val and test, unless the file has the lists
            {train,val,test}_filenames.
    """

    def __init__(
        self,
        root: str,
        missing: Literal["skip", "refuse"] = "skip",
        depth_unit: Positive | None = None,
        test_every: Every = 10,
        **options: Any,
    ) -> None:
        super().__init__(root, **options)
        self.skip_missing, self.depth_unit, self.test_every = missing == "skip", depth_unit, test_every

    def split_files(self) -> Mapping[str, Path]:
        return {} if self._single else find_splits(self.root)

    def cameras_of(self, file: Path) -> Cameras | None:
        if self._single is None or not same_content(self._single.path, file):
            return super().cameras_of(file)
        return self._views(self._frames(self._single, range(len(self._single.frames)))).cameras

    @functools.cached_property
    def _single(self) -> Manifest | None:
        """Content of transforms.json; None if there is one file per split."""
        file = self.root / "transforms.json"
        return parse_manifest(file, _MASK_KEY, self.skip_missing) if file.is_file() else None

    def _manifest(self, split: str) -> Manifest:
        return self._single or read_manifest(self.root, split, _MASK_KEY, self.skip_missing)

    def read(self, split: str) -> FrameSet:
        manifest = self._manifest(split)
        indices = self._choose(manifest, split) if self._single else range(len(manifest.frames))
        return self._frames(manifest, indices)

    def _frames(self, manifest: Manifest, indices: Sequence[int]) -> FrameSet:
        entries: Any = manifest.document["frames"]
        frames, stated = [manifest.frames[i] for i in indices], [entries[i].get("mask_path") for i in indices]
        usable = [path and find_mask(self.root, frame.image, path) for path, frame in zip(stated, frames, strict=True)]
        depths = [] if self.depth_unit is None else [self._depth_file(manifest, entries[i]) for i in indices]
        lenses, unit, turntable = manifest.lenses(indices), self.depth_unit or 1.0, manifest.turntable
        return FrameSet(
            frames, lenses, "opengl", *self._bounds,
            usable=usable, depths=depths, depth_unit=unit, turntable=turntable,
        )  # fmt: skip

    def _depth_file(self, manifest: Manifest, entry: Mapping[str, Any]) -> Path:
        stated = entry.get("depth_file_path")
        if not isinstance(stated, str):
            name = entry["file_path"]
            raise NerfroError(f"{manifest.path}: '{name}' has no depth_file_path; add it, or leave data.depth_unit out")
        return self.root / stated.replace("\\", "/")

    @functools.cached_property
    def _bounds(self) -> tuple[float, float]:
        """Return the bounds, which are estimated from the training cameras for all splits."""
        if self.near is not None and self.far is not None:
            return self.near, self.far
        manifest = self._manifest("train" if "train" in self.splits else self.splits[0])
        points, file = np.empty((0, 3)), manifest.document.get("ply_file_path")
        check(f"{manifest.path}: ", {"ply_file_path": str}, {"ply_file_path": file})
        path = self.root / str(file or "").replace("\\", "/")
        if os.path.isfile(path):  # False for a name that is too long
            points = usable_points(load_points(path), path)
        elif file:
            warn(
                f"the points {path} (ply_file_path) do not exist, so near and far are estimated from the cameras; "
                "restore the file, set data.near and data.far, or remove the key"
            )
        width, height, _ = read_size(manifest.frames[0].image)
        edges = np.stack([image_edges(lens, width, height) for lens in manifest.lenses()])
        return find_bounds(np.stack([frame.camera_to_world for frame in manifest.frames]), edges, points)

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
        index_of = {manifest.frames[i].name: i for i in by_name}
        names = [PurePosixPath(name.replace("\\", "/")).as_posix() for name in names]
        unknown = [name for name in names if name not in index_of and name not in manifest.skipped]
        if unknown:
            raise NerfroError(f"{manifest.path}: {split}_filenames lists '{unknown[0]}', but no frame has this name")
        indices = [index_of[name] for name in names if name in index_of]
        if not indices:
            raise NerfroError(f"{manifest.path}: no image of {split}_filenames exists; restore {names[0]}")
        return indices
