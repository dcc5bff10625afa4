"""Data format of the synthetic NeRF scenes (Blender)."""

from __future__ import annotations

import math

from nerfro.allowed import Distance, Factor
from nerfro.data.frames import FrameSet, Lens, PosedImages
from nerfro.data.image_files import Alpha, read_size
from nerfro.data.transforms import find_splits, is_number, read_manifest
from nerfro.errors import NerfroError
from nerfro.registry import register


@register("data", "blender")
class BlenderData(PosedImages):
    """Read the Blender format of the synthetic NeRF scenes: `transforms_{train,val,test}.json`.

    Poses have OpenGL camera axes; all images share one horizontal field of view. `embedded:torus` is the scene that is
    distributed with nerfro. `PosedImages` describes the options.
    """

    def __init__(
        self,
        root: str = "embedded:torus",
        near: Distance = 2.0,
        far: Distance = 6.0,
        downscale: Factor = 1,
        alpha: Alpha = "drop",
    ) -> None:
        super().__init__(root, near, far, downscale, alpha)

    @property
    def splits(self) -> list[str]:
        return list(find_splits(self.root))

    def read(self, split: str) -> FrameSet:
        manifest = read_manifest(self.root, split)
        angle = manifest.require("camera_angle_x", "the horizontal field of view in radians")
        if not is_number(angle) or not 0 < angle < math.pi:
            raise NerfroError(f"{manifest.path}: camera_angle_x={angle!r} must be an angle in radians, 0 to pi")
        width, height, _ = read_size(manifest.frames[0].image)
        lenses = [Lens.of_angle(angle, width, height)] * len(manifest.frames)
        return FrameSet(manifest.frames, lenses, "opengl", size=manifest.size)
