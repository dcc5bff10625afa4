"""Data in the format of the NeRF authors' Blender scenes."""

from __future__ import annotations

import math

from nerfro.allowed import Distance, Factor
from nerfro.data.base import Views
from nerfro.data.frames import Lens, PosedImages
from nerfro.data.image_files import Alpha
from nerfro.data.transforms import find_splits, is_number, read_manifest
from nerfro.errors import NerfroError
from nerfro.registry import register


@register("data", "blender")
class BlenderData(PosedImages):
    """Folder with transforms_{train,val,test}.json in Blender's (OpenGL) camera axes and one field of view.

    The options are those of `PosedImages`; the paper's authors drop transparency. `embedded:torus` ships with nerfro.
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

    def load(self, split: str) -> Views:
        manifest = read_manifest(self.root, split)
        angle = manifest.require("camera_angle_x", "the horizontal field of view in radians")
        if not is_number(angle) or not 0 < angle < math.pi:
            raise NerfroError(
                f"{manifest.path}: camera_angle_x={angle!r} must be an angle between 0 and pi, in radians"
            )
        frames, size = manifest.frames, manifest.size
        return self.views(frames, lambda w, h: [Lens.of_angle(angle, w, h)] * len(frames), "opengl", size=size)
