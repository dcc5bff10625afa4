"""Surroundings at infinity as a function of direction, and their lat-long textures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerfro.files import lat_long

Sky = Callable[[np.ndarray], np.ndarray]
"""Maps unit directions [..., 3], z up, to linear radiance [..., 3] of at most 1, so that 8-bit images never clip."""


def lat_long_texture(sky: Sky, height: int, supersampling: int = 2) -> np.ndarray:
    """Return the sky as a float32 lat-long image [H, 2H, 3] of linear radiance, averaged over each pixel."""
    k = supersampling
    texture = np.empty((height, 2 * height, 3), np.float32)
    fine = lat_long.directions(k * height).numpy()
    for row in range(height):  # by rows, because the intermediate arrays of a 4k sky exceed the memory
        band = sky(fine[k * row : k * (row + 1)])
        texture[row] = band.reshape(k, 2 * height, k, 3).mean((0, 2))
    return texture
