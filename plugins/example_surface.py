"""Template: a surface of your own in one file. Use it with `bodies={ring: {surface: {name: torus}, ior: 1.5}}`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.parts import Grid, Positive, Surface, register


@register("surface", "torus")
class Torus(Surface):
    """A torus around the z axis.

    Args:
        radius: radius of the circle in the middle of the tube, world units.
        tube_radius: radius of the tube, world units.
    """

    def __init__(self, radius: Positive = 0.8, tube_radius: Positive = 0.3) -> None:
        self._radius, self._tube_radius = radius, tube_radius
        reach = np.array([radius + tube_radius, radius + tube_radius, tube_radius])
        self.bounds = np.stack([-reach, reach])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        x, y, z = np.moveaxis(grid.points, -1, 0)
        return np.hypot(np.hypot(x, y) - self._radius, z) - self._tube_radius
