"""Signed distances to bodies at a point, and lines through boxes and blocks of cells, for kernels.

The mathematics is that of `geometry.interpolation` and `media.distance_grid`, for one point at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from nerfro.kernels.compilation import compiled
from nerfro.kernels.tolerances import BEYOND_BOX

# Unsigned, because Numba tests signed indices for negative values at each access.
_UINT = np.uintp


class Solids(NamedTuple):
    """Bodies of constant index with distance grids, as kernels take them (`media.bodies`, `media.distance_grid`).

    The grids of all bodies follow each other in flat arrays.
    """

    # Corners of each body's grid, world units, and cells per world unit.
    low: Float[np.ndarray, "K 3"]
    high: Float[np.ndarray, "K 3"]
    inverse_spacing: Float[np.ndarray, "K 3"]
    min_step: Float[np.ndarray, "K"]  # shortest step of the search for the body's surface, world units
    # Coefficients of the splines, the first coefficient of each body, and its numbers of vertices.
    coefficients: Float[np.ndarray, " coefficients"]
    start: Int[np.ndarray, "K"]
    shape: Int[np.ndarray, "K 3"]
    # Blocks of cells: lowest and highest derivatives of the spline, number of empty blocks around (negative inside the
    # body), the first block of each body, its numbers of blocks, and blocks per world unit.
    slopes: Float[np.ndarray, "blocks 3 2"]
    empty: Int8[np.ndarray, " blocks"]
    block_start: Int[np.ndarray, "K"]
    block_shape: Int[np.ndarray, "K 3"]
    inverse_block: Float[np.ndarray, "K 3"]
    # Refractive index of air and of each body, and whether each absorbs light.
    iors: Float[np.ndarray, " media"]
    absorbs: Bool[np.ndarray, " media"]
    # Corners of the box of all bodies, world units.
    box_low: Float[np.ndarray, "3"]
    box_high: Float[np.ndarray, "3"]
    nested: bool  # whether each body is bounded by all previous bodies
    shell: float  # half width of the smooth interfaces, world units


class Grid(NamedTuple):
    """Place of a body's spline: first coefficient, numbers of vertices, lower corner, and cells per world unit."""

    start: int
    nx: int
    ny: int
    nz: int
    low_x: float
    low_y: float
    low_z: float
    per_x: float
    per_y: float
    per_z: float


@compiled
def grid_of(solids, body):
    """Return the place of a body's spline in the arrays of all bodies."""
    nx, ny, nz = solids.shape[body, 0], solids.shape[body, 1], solids.shape[body, 2]
    low, per = solids.low[body], solids.inverse_spacing[body]
    return Grid(solids.start[body], nx, ny, nz, low[0], low[1], low[2], per[0], per[1], per[2])


@compiled
def _stencil(place, count):
    """Return the first of the three vertices of a spline along an axis, and the offset from the middle vertex."""
    middle = min(max(math.floor(place + 0.5), 1), count - 2)
    return _UINT(middle - 1), min(max(place - middle, -1.5), 1.5)


@compiled
def _weights(t):
    return 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)


@compiled
def _slopes(t):
    return t - 0.5, -2.0 * t, t + 0.5


@compiled
def spline_value(coefficients, grid, x, y, z):
    """Evaluate a quadratic B-spline on a grid."""
    i, tx = _stencil((x - grid.low_x) * grid.per_x, grid.nx)
    j, ty = _stencil((y - grid.low_y) * grid.per_y, grid.ny)
    k, tz = _stencil((z - grid.low_z) * grid.per_z, grid.nz)
    wx, wy, wz = _weights(tx), _weights(ty), _weights(tz)
    row, plane_size = _UINT(grid.nz), _UINT(grid.ny * grid.nz)
    first = _UINT(grid.start) + i * plane_size + j * row + k
    value = 0.0
    for a in range(3):
        plane = 0.0
        for b in range(3):
            line = 0.0
            for c in range(3):
                line += wz[c] * coefficients[first + _UINT(a) * plane_size + _UINT(b) * row + _UINT(c)]
            plane += wy[b] * line
        value += wx[a] * plane
    return value


@compiled
def spline_value_gradient(coefficients, grid, x, y, z):
    """Evaluate a quadratic B-spline on a grid and its exact gradient."""
    i, tx = _stencil((x - grid.low_x) * grid.per_x, grid.nx)
    j, ty = _stencil((y - grid.low_y) * grid.per_y, grid.ny)
    k, tz = _stencil((z - grid.low_z) * grid.per_z, grid.nz)
    wx, wy, wz = _weights(tx), _weights(ty), _weights(tz)
    ux, uy, uz = _slopes(tx), _slopes(ty), _slopes(tz)
    row, plane_size = _UINT(grid.nz), _UINT(grid.ny * grid.nz)
    first = _UINT(grid.start) + i * plane_size + j * row + k
    value, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        plane, plane_y, plane_z = 0.0, 0.0, 0.0
        for b in range(3):
            line, line_z = 0.0, 0.0
            for c in range(3):
                value_there = coefficients[first + _UINT(a) * plane_size + _UINT(b) * row + _UINT(c)]
                line += wz[c] * value_there
                line_z += uz[c] * value_there
            plane += wy[b] * line
            plane_y += uy[b] * line
            plane_z += wy[b] * line_z
        value += wx[a] * plane
        gx += ux[a] * plane
        gy += wx[a] * plane_y
        gz += wx[a] * plane_z
    return value, gx * grid.per_x, gy * grid.per_y, gz * grid.per_z


@compiled
def nearest_in_box(low, high, x, y, z):
    """Return the nearest point of a box, and the squared distance to it."""
    nx = min(max(x, low[0]), high[0])
    ny = min(max(y, low[1]), high[1])
    nz = min(max(z, low[2]), high[2])
    return nx, ny, nz, (x - nx) ** 2 + (y - ny) ** 2 + (z - nz) ** 2


@compiled
def distance_from(phi, beyond):
    """Bound the distance to a body at a point, given that at the nearest point of its box (`media.distance_grid`).

    Args:
        phi: signed distance to the body at the nearest point of the box.
        beyond: squared distance to the box.
    """
    return math.sqrt(beyond + phi * phi) if beyond > 0.0 and phi > 0.0 else phi


@compiled
def body_distance(solids, body, x, y, z):
    """Return the signed distance to a body, or outside of its box a lower bound."""
    x, y, z, beyond = nearest_in_box(solids.low[body], solids.high[body], x, y, z)
    return distance_from(spline_value(solids.coefficients, grid_of(solids, body), x, y, z), beyond)


@compiled
def block_at(counts, bx, by, bz):
    """Return the indices of the block that contains a point, or of the nearest block."""
    i = min(max(int(bx), 0), counts[0] - 1)
    j = min(max(int(by), 0), counts[1] - 1)
    k = min(max(int(bz), 0), counts[2] - 1)
    return _UINT(i), _UINT(j), _UINT(k)


@compiled
def block_number(start, counts, i, j, k):
    """Return the number of a block in a flat array of the blocks of all bodies."""
    return _UINT(start) + (i * _UINT(counts[1]) + j) * _UINT(counts[2]) + k


@compiled
def blocks_from(low, inverse_size, x, y, z):
    """Return a point's coordinates in blocks from the grid's corner."""
    return (x - low[0]) * inverse_size[0], (y - low[1]) * inverse_size[1], (z - low[2]) * inverse_size[2]


@compiled
def box_span(low, high, x, y, z, dx, dy, dz):
    """Return the distances at which a line enters and leaves a box; enter > leave if the line misses the box."""
    enter, leave = -math.inf, math.inf
    for axis in range(3):
        position = x if axis == 0 else (y if axis == 1 else z)
        direction = dx if axis == 0 else (dy if axis == 1 else dz)
        if direction == 0.0:
            if position < low[axis] or position > high[axis]:
                return math.inf, -math.inf
            continue
        first = (low[axis] - position) / direction
        second = (high[axis] - position) / direction
        enter = max(enter, min(first, second))
        leave = min(leave, max(first, second))
    return enter, leave


@compiled
def distance_out(low, high, x, y, z, dx, dy, dz):
    """Return a distance after which a ray from inside a box, or from near the box, is outside."""
    shortest = min(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    return max(box_span(low, high, x, y, z, dx, dy, dz)[1], 0.0) + BEYOND_BOX * shortest
