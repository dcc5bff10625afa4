"""What a scene is: a glass body, coloured things inside it, and its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerfro.scenes.distance import Colour, Vector
from nerfro.scenes.skies import Sky
from nerfro.scenes.surface import Surface


@dataclass(frozen=True)
class Panel:
    """A picture on a rectangle, seen from the side on which it is unmirrored; its back is black.

    Attributes:
        corner: its upper left corner [3], world units.
        right: its upper edge [3], from left to right.
        down: its left edge [3], from above.
        picture: sRGB in [0, 1], float32 [H, W, 3].
        glows: whether the picture is light that it sends out equally in all directions, or else its albedo.
        smooth: whether the picture is interpolated between its pixels.
    """

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    picture: np.ndarray
    glows: bool = False
    smooth: bool = True

    @property
    def to_world(self) -> np.ndarray:
        """Matrix [4, 4] from the square [-1, 1]^2 of x (to the right) and y (upwards), and z towards the viewer."""
        matrix = np.eye(4)
        out = np.cross(self.down, self.right)
        columns = [0.5 * self.right, -0.5 * self.down, out / np.linalg.norm(out)]
        matrix[:3] = np.stack([*columns, self.corner + 0.5 * (self.right + self.down)], -1)
        return matrix


def painted_panel(
    corner: Vector, right: Vector, down: Vector, colour: Colour, spacing: float, glows: bool = False
) -> Panel:
    """Paint a rectangle with `colour`(points [..., 3]) -> sRGB [..., 3], one pixel every `spacing` world units."""
    corner, right, down = (np.asarray(vector, np.float64) for vector in (corner, right, down))
    width, height = (max(2, int(np.ceil(np.linalg.norm(edge) / spacing))) for edge in (right, down))
    across, along = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    points = corner + across[None, :, None] * right + along[:, None, None] * down
    return Panel(corner, right, down, np.clip(colour(points), 0.0, 1.0).astype(np.float32), glows)


@dataclass(frozen=True)
class Scene:
    """A refractive object in world units, z up.

    Attributes:
        ior: refractive index of the glass; the surroundings have 1.
        glass: closed outer surface of the glass.
        interior: coloured diffuse surfaces embedded in the glass; they never touch its outer surface.
        sky: linear radiance in [0, 1] from every direction, or None where panels close the scene.
        panels: flat things at finite distance around the object.
        tint: linear factor per colour channel on each crossing of the glass surface. Absorption along the path is not
            part of the paper's image formation, so tinted glass is tinted at its surface.
        absorption: of the glass, for each colour channel, per world unit of the path in it (Beer-Lambert).
        aim: what a photographer looks at.
    """

    ior: float
    glass: Surface
    interior: Surface
    sky: Sky | None
    panels: tuple[Panel, ...] = ()
    tint: Vector = (1.0, 1.0, 1.0)
    absorption: Vector = (0.0, 0.0, 0.0)
    aim: Vector = (0.0, 0.0, 0.0)
