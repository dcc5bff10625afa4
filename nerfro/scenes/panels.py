"""Flat pictures in space: walls, table tops, printed sheets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfro.scenes.distance import Vector


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
    corner: Vector,
    right: Vector,
    down: Vector,
    colour: Callable[[np.ndarray], np.ndarray],
    spacing: float,
    glows: bool = False,
) -> Panel:
    """Paint a rectangle with `colour`(points [..., 3]) -> sRGB [..., 3], one pixel every `spacing` world units."""
    corner, right, down = (np.asarray(vector, np.float64) for vector in (corner, right, down))
    width, height = (max(2, int(np.ceil(np.linalg.norm(edge) / spacing))) for edge in (right, down))
    across, along = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    points = corner + across[None, :, None] * right + along[:, None, None] * down
    return Panel(corner, right, down, np.clip(colour(points), 0.0, 1.0).astype(np.float32), glows)
