"""`surface: {name: box}`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.surface import Grid, Surface, vector
from nerfro.registry.allowed import Coordinate, NotNegative, Positive
from nerfro.registry.registration import register


@register("surface", "box")
class BoxSurface(Surface):
    """A box with sides along the axes of the world; with one short side, a pane. Sharp edges have triangles.

    Args:
        sides: lengths along x, y and z, world units.
        centre: world coordinates.
        rounding: radius of the edges, world units.
    """

    def __init__(
        self, sides: Sequence[Positive], centre: Sequence[Coordinate] = (0.0, 0.0, 0.0), rounding: NotNegative = 0.0
    ) -> None:
        self._half, self._centre, self._rounding = 0.5 * vector("sides", sides), vector("centre", centre), rounding
        if rounding > self._half.min():
            raise NerfroError(f"surface.rounding={rounding} is not allowed; give at most half of the shortest side")
        self.bounds = np.stack([self._centre - self._half, self._centre + self._half])
        if not rounding:
            import trimesh  # takes half a second

            box = trimesh.creation.box(bounds=self.bounds)
            self.mesh = TriangleMesh(np.array(box.vertices), np.array(box.faces), facets=np.arange(len(box.faces)))

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        excess = np.abs(grid.points - self._centre) - self._half + self._rounding
        return np.linalg.norm(excess.clip(min=0), axis=-1) + excess.max(-1).clip(max=0) - self._rounding
