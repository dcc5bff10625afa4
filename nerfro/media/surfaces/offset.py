"""`surface: {name: offset}`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.media.surface import Grid, Surface, make_surface
from nerfro.registry.allowed import Coordinate
from nerfro.registry.registration import register


@register("surface", "offset")
class OffsetSurface(Surface):
    """The points at a distance from another surface, such as the inside of a wall of constant thickness.

    Args:
        surface: name and settings of the other surface.
        distance: outwards, world units; negative for inwards.
    """

    def __init__(self, surface: dict[str, Any], distance: Coordinate) -> None:
        self._other, self._distance = make_surface(surface), distance
        self.bounds = self._other.bounds + np.array([[-1], [1]]) * max(distance, 0)
        self.known = self._other.known
        if self.known is not None and ((self.bounds[0] < self.known[0]) | (self.bounds[1] > self.known[1])).any():
            raise NerfroError(
                f"surface.distance={distance} leads out of the grid of the other surface; write a larger grid, or take "
                "a smaller distance"
            )

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return self._other.distances(grid.widened(abs(self._distance))) - self._distance
