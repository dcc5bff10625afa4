"""Data formats with a transforms file per split: the synthetic NeRF scenes (Blender), and the captures of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Gt, Le

from nerfro.data.frames import FrameSet, PosedImages
from nerfro.data.transforms import find_splits, read_manifest
from nerfro.registry.allowed import Distance
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
