"""`surface: {name: ball}`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerfro.media.surface import Grid, Surface, vector
from nerfro.registry.allowed import Coordinate, Positive
from nerfro.registry.registration import register


@register("surface", "ball")
class BallSurface(Surface):
    """A ball.

    Args:
        radius: world units.
        centre: world coordinates.
    """

    def __init__(self, radius: Positive, centre: Sequence[Coordinate] = (0.0, 0.0, 0.0)) -> None:
        self._radius, self._centre = radius, vector("centre", centre)
        self.bounds = np.stack([self._centre - radius, self._centre + radius])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.linalg.norm(grid.points - self._centre, axis=-1) - self._radius
