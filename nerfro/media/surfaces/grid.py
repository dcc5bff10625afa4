"""`surface: {name: grid}`."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.files.reading import load_arrays
from nerfro.media.distance_grid import DistanceGrid
from nerfro.media.surface import Grid, Surface
from nerfro.registry.registration import register


@register("surface", "grid")
class GridSurface(Surface):
    """Zero level of signed distances in a file, interpolated by quadratic B-splines.

    Args:
        file: NumPy archive (.npz) with `distances` [X, Y, Z] at the vertices of a grid, negative inside and positive at
            the border, and the lower and upper corner of the grid, `box` [2, 3]; world units.
    """

    def __init__(self, file: str) -> None:
        arrays = load_arrays(resolve_path(file))
        distances, box = (np.asarray(arrays.get(name), np.float64) for name in ("distances", "box"))
        if distances.ndim != 3 or min(distances.shape) < 3 or box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise NerfroError(f"{file} is no grid of distances; write the arrays distances [X, Y, Z] and box [2, 3]")
        inside = np.argwhere(distances < 0)
        last = np.array(distances.shape) - 1
        if not len(inside) or not np.isfinite(distances).all() or inside.min() < 1 or (inside == last).any():
            raise NerfroError(f"{file}: the distances must be negative inside the body and positive at the border")
        self._grid = DistanceGrid(torch.from_numpy(distances), torch.from_numpy(box))
        spacing = (box[1] - box[0]) / last
        self.known, self.bounds = box, box[0] + spacing * np.stack([inside.min(0) - 1, inside.max(0) + 1])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.stack([self._grid(torch.from_numpy(plane))[0].numpy() for plane in grid.points])
