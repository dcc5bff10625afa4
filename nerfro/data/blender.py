"""Data in the format of the NeRF authors' Blender scenes."""

from __future__ import annotations

import math
from typing import Literal

from nerfro.data.base import DataSource, Views
from nerfro.data.frames import Lens, check_options, load_views
from nerfro.data.transforms import find_splits, is_number, read_manifest
from nerfro.errors import NerfroError
from nerfro.paths import resolve_path
from nerfro.registry import register


@register("data", "blender")
class BlenderData(DataSource):
    """Folder with transforms_{train,val,test}.json in Blender's (OpenGL) camera axes and one field of view.

    Args:
        root: the folder; `embedded:torus` is the scene that ships with nerfro.
        near: arc length at which rays begin, world units.
        far: arc length at which rays end, world units.
        downscale: side of the blocks of pixels that are averaged into one.
        alpha: `drop` ignores the images' transparency as the paper's authors do, `white` and `black` composite them
            over that colour.

    Raises:
        NerfroError: an option is out of range.
    """

    def __init__(
        self,
        root: str = "embedded:torus",
        near: float = 2.0,
        far: float = 6.0,
        downscale: int = 1,
        alpha: Literal["drop", "white", "black"] = "drop",
    ) -> None:
        check_options(near, far, downscale)
        self.root = resolve_path(root)
        self.near, self.far, self.downscale, self.alpha = near, far, downscale, alpha

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

        def lenses(width: int, height: int) -> list[Lens]:
            return [Lens.of_angle(angle, width, height)] * len(manifest.frames)

        bounds = self.near, self.far
        return load_views(manifest.frames, lenses, "opengl", bounds, self.downscale, self.alpha, manifest.size)
