"""Refractive index at a point for kernels, from a voxel grid or from grids of signed distances.

The mathematics is that of `geometry.interpolation` and `media.solid`, for one point at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from nerfro.kernels.compilation import compiled
from nerfro.kernels.tolerances import BEYOND_BOX, SAFE_SHARE

# Unsigned, because Numba tests signed indices for negative values at each access.
_UINT = np.uintp


class MediumGrid(NamedTuple):
    """A medium on a grid, as kernels take it. Numba compiles a kernel separately for fields that are None."""

    # Index and its gradient at the grid's vertices [X, Y, Z, 4] (`media.voxel_grid`); or coefficients of the bodies'
    # splines [K, X, Y, Z] (`media.sdf_grid`).
    values: Float[np.ndarray, "..."]
    clearance: Float[np.ndarray, "x y z"]  # distance within which the index is constant, of blocks of cells
    iors: Float[np.ndarray, "K"] | None  # index of each body; None if the values are the index
    nested: bool  # whether each body is bounded by all previous bodies (`media.solid`)
    shell: float  # half width of the bodies' smooth interface, world units
    # Corners of the grid, world units.
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    # Cells and blocks per world unit.
    inverse_spacing: Float[np.ndarray, "3"]
    inverse_block: Float[np.ndarray, "3"]
    # Smaller blocks for the search of surfaces; None without bodies. Lowest and highest derivatives of the bodies'
    # splines, number of empty blocks around each block, and blocks per world unit.
    slopes: Float[np.ndarray, "K x y z 3 2"] | None
    empty: UInt8[np.ndarray, "x y z"] | None
    inverse_small: Float[np.ndarray, "3"] | None


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
def spline_value(coefficients, low, inverse_spacing, x, y, z):
    """Evaluate a quadratic B-spline on a grid."""
    i, tx = _stencil((x - low[0]) * inverse_spacing[0], coefficients.shape[0])
    j, ty = _stencil((y - low[1]) * inverse_spacing[1], coefficients.shape[1])
    k, tz = _stencil((z - low[2]) * inverse_spacing[2], coefficients.shape[2])
    wx, wy, wz = _weights(tx), _weights(ty), _weights(tz)
    value = 0.0
    for a in range(3):
        plane = 0.0
        for b in range(3):
            line = 0.0
            for c in range(3):
                line += wz[c] * coefficients[i + _UINT(a), j + _UINT(b), k + _UINT(c)]
            plane += wy[b] * line
        value += wx[a] * plane
    return value


@compiled
def spline_value_gradient(coefficients, low, inverse_spacing, x, y, z):
    """Evaluate a quadratic B-spline on a grid and its exact gradient."""
    i, tx = _stencil((x - low[0]) * inverse_spacing[0], coefficients.shape[0])
    j, ty = _stencil((y - low[1]) * inverse_spacing[1], coefficients.shape[1])
    k, tz = _stencil((z - low[2]) * inverse_spacing[2], coefficients.shape[2])
    wx, wy, wz = _weights(tx), _weights(ty), _weights(tz)
    ux, uy, uz = _slopes(tx), _slopes(ty), _slopes(tz)
    value, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        plane, plane_y, plane_z = 0.0, 0.0, 0.0
        for b in range(3):
            line, line_z = 0.0, 0.0
            for c in range(3):
                value_there = coefficients[i + _UINT(a), j + _UINT(b), k + _UINT(c)]
                line += wz[c] * value_there
                line_z += uz[c] * value_there
            plane += wy[b] * line
            plane_y += uy[b] * line
            plane_z += wy[b] * line_z
        value += wx[a] * plane
        gx += ux[a] * plane
        gy += wx[a] * plane_y
        gz += wx[a] * plane_z
    return value, gx * inverse_spacing[0], gy * inverse_spacing[1], gz * inverse_spacing[2]


@compiled
def solid_clearance(coefficients, shell, low, inverse_spacing, x, y, z):
    """Return a lower bound of the distance to the nearest shell of nested bodies (`media.solid`)."""
    clearance = math.inf
    for body in range(coefficients.shape[0]):
        phi = spline_value(coefficients[body], low, inverse_spacing, x, y, z)
        clearance = min(clearance, SAFE_SHARE * abs(phi) - shell)
    return max(clearance, 0.0)


@compiled
def solid_index(coefficients, iors, nested, shell, low, inverse_spacing, x, y, z):
    """Return index, gradient of the index and clearance of bodies with smooth shells (`media.solid`)."""
    n, gx, gy, gz, clearance = 1.0, 0.0, 0.0, 0.0, math.inf
    within, rx, ry, rz = 1.0, 0.0, 0.0, 0.0
    for body in range(coefficients.shape[0]):
        phi, px, py, pz = spline_value_gradient(coefficients[body], low, inverse_spacing, x, y, z)
        clearance = min(clearance, SAFE_SHARE * abs(phi) - shell)
        t = 0.5 - 0.5 * phi / shell
        if t <= 0.0:
            if nested:
                break
            continue
        if t >= 1.0 and within == 1.0:
            n, gx, gy, gz = iors[body], 0.0, 0.0, 0.0
            continue
        t = min(t, 1.0)
        step = t * t * (3.0 - 2.0 * t)
        slope = 6.0 * t * (1.0 - t) * (-0.5 / shell)
        px, py, pz = slope * px, slope * py, slope * pz
        if nested:
            px, py, pz = rx * step + within * px, ry * step + within * py, rz * step + within * pz
            step *= within
            within, rx, ry, rz = step, px, py, pz
        change = iors[body] - n
        gx = gx * (1.0 - step) + change * px
        gy = gy * (1.0 - step) + change * py
        gz = gz * (1.0 - step) + change * pz
        n += change * step
    return n, gx, gy, gz, max(clearance, 0.0)


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
def block_at(counts, bx, by, bz):
    """Return the indices of the block that contains a point, or of the nearest block."""
    i = min(max(int(bx), 0), counts[0] - 1)
    j = min(max(int(by), 0), counts[1] - 1)
    k = min(max(int(bz), 0), counts[2] - 1)
    return _UINT(i), _UINT(j), _UINT(k)


@compiled
def blocks_from(low, inverse_size, x, y, z):
    """Return a point's coordinates in blocks from the grid's corner."""
    return (x - low[0]) * inverse_size[0], (y - low[1]) * inverse_size[1], (z - low[2]) * inverse_size[2]


@compiled
def block_clearance(clearance, low, inverse_size, x, y, z):
    """Return the distance around a point's block within which the index is constant."""
    bx, by, bz = blocks_from(low, inverse_size, x, y, z)
    return clearance[block_at(clearance.shape, bx, by, bz)]


@compiled
def lengths_of_block(rx, ry, rz):
    """Return the length of a line per block along each axis, given the blocks per unit length."""
    qx, qy, qz = math.inf, math.inf, math.inf
    if rx != 0.0:
        qx = 1.0 / rx
    if ry != 0.0:
        qy = 1.0 / ry
    if rz != 0.0:
        qz = 1.0 / rz
    return qx, qy, qz


@compiled
def _end_along(i, reach, b, q):
    """Return the distance at which a line leaves along one axis; infinite for parallel lines, even on a face."""
    if math.isinf(q):
        return math.inf
    return ((i + reach if q > 0.0 else i + 1.0 - reach) - b) * q


@compiled
def end_of_blocks(i, j, k, reach, bx, by, bz, qx, qy, qz):
    """Return the distance at which a line leaves the blocks that are less than `reach` away from block (i, j, k)."""
    i, j, k, reach = float(i), float(j), float(k), float(reach)
    end_y, end_z = _end_along(j, reach, by, qy), _end_along(k, reach, bz, qz)
    return min(_end_along(i, reach, bx, qx), min(end_y, end_z))


@compiled
def slopes_along(slopes, i, j, k, dx, dy, dz, lowest, highest):
    """Bound each body's slope along a line in a block; return whether every spline is monotone."""
    monotone, direction = True, (dx, dy, dz)
    for body in range(slopes.shape[0]):
        least, most = 0.0, 0.0
        for axis in range(3):
            bounds = slopes[_UINT(body), i, j, k, _UINT(axis)]
            one, other = direction[axis] * bounds[0], direction[axis] * bounds[1]
            least += min(one, other)
            most += max(one, other)
        lowest[body], highest[body] = least, most
        monotone = monotone and (least > 0.0 or most < 0.0)
    return monotone


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


@compiled
def put_vertex(positions, directions, s, count, x, y, z, dx, dy, dz, length):
    """Append a vertex to a polyline; vertices beyond the capacity are only counted."""
    if count < s.shape[0]:
        positions[count, 0], positions[count, 1], positions[count, 2] = x, y, z
        directions[count, 0], directions[count, 1], directions[count, 2] = dx, dy, dz
        s[count] = length
    return count + 1


@compiled
def put_end(positions, directions, s, count, low, high, bent, x, y, z, dx, dy, dz, length, far):
    """Append the last vertex at `far`, or farther if a bent path has not left the box by then."""
    ahead = far - length
    if bent:
        ahead = max(ahead, distance_out(low, high, x, y, z, dx, dy, dz))
    return put_vertex(
        positions, directions, s, count, x + ahead * dx, y + ahead * dy, z + ahead * dz, dx, dy, dz, length + ahead
    )


@compiled
def repeat_last(positions, directions, s, count):
    """Fill the rest of a polyline with the last vertex."""
    last = min(count, s.shape[0]) - 1
    for i in range(last + 1, s.shape[0]):
        for axis in range(3):
            positions[i, axis], directions[i, axis] = positions[last, axis], directions[last, axis]
        s[i] = s[last]
