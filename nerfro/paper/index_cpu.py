"""Refractive index at a point for kernels, from a voxel grid or from bodies with thin shells.

The mathematics is that of `geometry.interpolation` and `media.bodies`, for one point at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerfro.kernels.compilation import compiled
from nerfro.kernels.lookup import Solids, distance_from, grid_of, nearest_in_box, spline_value_gradient
from nerfro.kernels.tolerances import SAFE_SHARE


class Voxels(NamedTuple):
    """A medium whose index varies on a grid, as kernels take it (`voxel_grid.VoxelGrid`)."""

    table: Float[np.ndarray, "X Y Z 4"]  # index and its gradient at the vertices
    clearance: Float[np.ndarray, "x y z"]  # distance within which the index is constant, of each cell
    # Corners of the grid, world units, and cells per world unit.
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    inverse_spacing: Float[np.ndarray, "3"]


# Arguments of kernels that take a medium of either type.
NO_VOXELS = Voxels(np.empty((0, 0, 0, 4), np.float32), np.empty((0, 0, 0), np.float32), *np.empty((3, 3)))
_corners, _lengths, _counts, _numbers = np.empty((0, 3)), np.empty(0), np.empty((0, 3), np.int64), np.empty(0, np.int64)
_values, _bounds, _bytes = np.empty(0, np.float32), np.empty((0, 3, 2), np.float32), np.empty(0, np.int8)
NO_SOLIDS = Solids(
    _corners, _corners, _corners, _lengths, _values, _numbers, _counts, _bounds, _bytes, _numbers, _counts, _corners,
    _lengths, np.empty(0, np.bool_), np.empty(3), np.empty(3), False, 0.0,
)  # fmt: skip


@compiled
def voxel_index(table, low, inverse_spacing, x, y, z):
    """Interpolate index and gradient on a grid trilinearly; outside, n = 1 and the gradient is zero."""
    fx = (x - low[0]) * inverse_spacing[0]
    fy = (y - low[1]) * inverse_spacing[1]
    fz = (z - low[2]) * inverse_spacing[2]
    top_x, top_y, top_z = table.shape[0] - 1, table.shape[1] - 1, table.shape[2] - 1
    if not (0.0 <= fx <= top_x and 0.0 <= fy <= top_y and 0.0 <= fz <= top_z):
        return 1.0, 0.0, 0.0, 0.0
    i, j, k = min(int(fx), top_x - 1), min(int(fy), top_y - 1), min(int(fz), top_z - 1)
    tx, ty, tz = fx - i, fy - j, fz - k
    n, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for a in range(2):
        wa = tx if a else 1.0 - tx
        for b in range(2):
            wb = wa * (ty if b else 1.0 - ty)
            for c in range(2):
                w = wb * (tz if c else 1.0 - tz)
                row = table[i + a, j + b, k + c]
                n += w * row[0]
                gx += w * row[1]
                gy += w * row[2]
                gz += w * row[3]
    return n, gx, gy, gz


@compiled
def solid_index(solids, x, y, z):
    """Return index, gradient of the index and clearance of bodies with smooth shells (`media.bodies`)."""
    shell, nested = solids.shell, solids.nested
    n, gx, gy, gz, clearance = 1.0, 0.0, 0.0, 0.0, math.inf
    within, rx, ry, rz = 1.0, 0.0, 0.0, 0.0
    for body in range(len(solids.low)):
        ior = solids.iors[body + 1]
        nx, ny, nz, beyond = nearest_in_box(solids.low[body], solids.high[body], x, y, z)
        phi, px, py, pz = spline_value_gradient(solids.coefficients, grid_of(solids, body), nx, ny, nz)
        if beyond > 0.0 and phi > 0.0:  # the shell is inside of the box
            clearance = min(clearance, SAFE_SHARE * distance_from(phi, beyond) - shell)
            if nested:
                break
            continue
        clearance = min(clearance, SAFE_SHARE * abs(phi) - shell)
        t = 0.5 - 0.5 * phi / shell
        if t <= 0.0:
            if nested:
                break
            continue
        if t >= 1.0 and within == 1.0:
            n, gx, gy, gz = ior, 0.0, 0.0, 0.0
            continue
        t = min(t, 1.0)
        step = t * t * (3.0 - 2.0 * t)
        slope = 6.0 * t * (1.0 - t) * (-0.5 / shell)
        px, py, pz = slope * px, slope * py, slope * pz
        if nested:
            px, py, pz = rx * step + within * px, ry * step + within * py, rz * step + within * pz
            step *= within
            within, rx, ry, rz = step, px, py, pz
        change = ior - n
        gx = gx * (1.0 - step) + change * px
        gy = gy * (1.0 - step) + change * py
        gz = gz * (1.0 - step) + change * pz
        n += change * step
    return n, gx, gy, gz, max(clearance, 0.0)
