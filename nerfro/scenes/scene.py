"""Description of a scene: a glass body, coloured objects inside, and the surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfro.scenes.sky import Sky
from nerfro.scenes.surface import Surface

Vector = Sequence[float] | np.ndarray
"""Three numbers along x, y, z."""


@dataclass(frozen=True)
class Panel:
    """A rectangle with an image on the front; the back is black.

    Attributes:
        corner: upper left corner [3], world units.
        right: upper edge [3], from left to right.
        down: left edge [3], from top to bottom.
        image: sRGB in [0, 1], float32 [H, W, 3].
        glows: whether the image is emitted radiance, equal in all directions, instead of albedo.
        smooth: whether the image is interpolated between pixels.
    """

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    image: np.ndarray
    glows: bool = False
    smooth: bool = True

    @property
    def to_world(self) -> np.ndarray:
        """Matrix [4, 4] from the square [-1, 1]^2 of x (right) and y (up) to the world; z points to the front."""
        matrix = np.eye(4)
        out = np.cross(self.down, self.right)
        columns = [0.5 * self.right, -0.5 * self.down, out / np.linalg.norm(out)]
        matrix[:3] = np.stack([*columns, self.corner + 0.5 * (self.right + self.down)], -1)
        return matrix


@dataclass(frozen=True)
class Scene:
    """A refractive object in world units, z up.

    Attributes:
        ior: refractive index of the glass; the index of the surroundings is 1.
        glass: closed outer surface of the glass.
        interior: coloured diffuse surfaces inside the glass, without contact to the outer surface.
        sky: linear radiance in [0, 1] from every direction, or None where panels close the scene.
        panels: flat surfaces at finite distance around the object.
        tint: linear factor per colour channel on each crossing of the glass surface, as in the paper's image formation,
            where paths are not absorbed.
        absorption: absorption of the glass for each colour channel, per world unit (Beer-Lambert).
        aim: point in the centre of the photographs.
    """

    ior: float
    glass: Surface
    interior: Surface
    sky: Sky | None
    panels: tuple[Panel, ...] = ()
    tint: Vector = (1.0, 1.0, 1.0)
    absorption: Vector = (0.0, 0.0, 0.0)
    aim: Vector = (0.0, 0.0, 0.0)
