"""Compiled search for the first surface on a line, among the zero levels of signed-distance solids.

Every body has a grid in a box of its own, so the search skips bodies whose boxes the line misses, or meets behind the
nearest surface found so far.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from nerfro.kernels.compilation import compiled
from nerfro.kernels.lookup import block_at, block_number, blocks_from, box_span, grid_of, spline_value

# Tolerance of roots, and distance of a step beyond the wall of a block, as fractions of the shortest step.
_ROOT_TOLERANCE, _BEYOND_WALL = 1e-6, 1e-3
# Largest number of iterations of the root search, and number of secants before bisection alternates with secants.
_ROOT_ITERATIONS, _SECANTS = 60, 6


class Line(NamedTuple):
    """A point and a unit direction, world units."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


@compiled
def advance(line, length):
    """Move the start of a line forwards."""
    x, y, z, dx, dy, dz = line
    return Line(x + length * dx, y + length * dy, z + length * dz, dx, dy, dz)


@compiled
def _distance_at(coefficients, grid, line, t):
    """Return the signed distance to a body's surface at arc length t of a line inside the body's box."""
    x, y, z, dx, dy, dz = line
    return spline_value(coefficients, grid, x + t * dx, y + t * dy, z + t * dz)


@compiled
def _inverse(rate):
    return 1.0 / rate if rate != 0.0 else math.inf


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
def _slope_along(bounds, dx, dy, dz):
    """Bound the slope of a body's distance along a line, given bounds of its derivatives along the axes [3, 2]."""
    least, most, direction = 0.0, 0.0, (dx, dy, dz)
    for axis in range(3):
        one, other = direction[axis] * bounds[axis, 0], direction[axis] * bounds[axis, 1]
        least += min(one, other)
        most += max(one, other)
    return least, most


@compiled
def _root(coefficients, grid, line, start, end, at_start, at_end, tolerance):
    """Shrink [start, end] around a change of sign by the method of Anderson and Bjorck; both ends keep their signs.

    The value at the end is known; the value at the start is known or NaN. Secants approach the root from one side until
    a secant exceeds the root; if none does, bisection alternates with secants.
    """
    if math.isnan(at_start):
        at_start = _distance_at(coefficients, grid, line, start)
    start_inside = at_start < 0.0
    weight_start, weight_end, moved = at_start, at_end, 0
    for iteration in range(_ROOT_ITERATIONS):
        if end - start <= tolerance:
            break
        if (iteration >= _SECANTS and iteration % 2 == 0) or weight_end == weight_start:
            middle = 0.5 * (start + end)
        else:
            middle = (start * weight_end - end * weight_start) / (weight_end - weight_start)
            # A step beyond the root moves the other end, too.
            middle = min(max(middle, start + 0.25 * tolerance), end - 0.25 * tolerance)
        value = _distance_at(coefficients, grid, line, middle)
        # Without a smaller weight, the same end would stay in all iterations.
        if (value < 0.0) == start_inside:
            if moved == 1:
                weight_end *= 1.0 - value / weight_start if abs(value) < abs(weight_start) else 0.5
            start, weight_start, moved = middle, value, 1
        else:
            if moved == 2:
                weight_start *= 1.0 - value / weight_end if abs(value) < abs(weight_end) else 0.5
            end, weight_end, moved = middle, value, 2
    return start, end


@compiled
def first_surface(solids, inside, crossings, line):
    """Find the first surface on a line.

    Args:
        solids: bodies.
        inside: whether the line starts inside each body's surface.
        crossings: array for the arc length behind the next surface of each body; infinite for bodies without a surface
            ahead. The search of a body ends a little behind the first surface that is known so far.
        line: the line.

    Returns:
        The body, or -1, and arc lengths before and after its surface.
    """
    hit, hit_before, hit_after = -1, 0.0, math.inf
    for body in range(len(inside)):
        limit = hit_after + solids.min_step[body]
        found, before, after = _surface_ahead(solids, body, inside[body], line, limit)
        crossings[body] = after if found else math.inf
        if found and after < hit_after:
            hit, hit_before, hit_after = body, before, after
    return hit, hit_before, hit_after


@compiled
def _surface_ahead(solids, body, inside, line, limit):
    """Find the first surface of a body on a line; returns whether there is one, and arc lengths before and after it.

    Blocks without a surface are skipped. In other blocks, steps are at least as long as the distance to the surface, as
    in sphere tracing. The bounds of the slope in a block allow longer steps. In a block with a monotonic distance there
    is at most one surface, between values of opposite sign, so one step crosses the block.

    Args:
        solids: bodies.
        body: body that is searched.
        inside: whether the line starts inside its surface.
        line: the line.
        limit: arc length at which the search ends.
    """
    x, y, z, dx, dy, dz = line
    enter, leave = box_span(solids.low[body], solids.high[body], x, y, z, dx, dy, dz)
    t, leave = max(enter, 0.0), min(leave, limit)
    if not t < leave:
        return False, 0.0, 0.0
    coefficients, grid, min_step = solids.coefficients, grid_of(solids, body), solids.min_step[body]
    counts, small = solids.block_shape[body], solids.inverse_block[body]
    # Direction and start in units of blocks, and arc lengths for one block along each axis.
    rx, ry, rz = dx * small[0], dy * small[1], dz * small[2]
    bx, by, bz = blocks_from(solids.low[body], small, x, y, z)
    qx, qy, qz = _inverse(rx), _inverse(ry), _inverse(rz)
    beyond = _BEYOND_WALL * min_step
    # Signed distances at the last point and at the point before; NaN if unknown.
    before, at_before, at_point, across = t, math.nan, math.nan, False
    while True:
        i, j, k = block_at(counts, bx + t * rx, by + t * ry, bz + t * rz)
        block = block_number(solids.block_start[body], counts, i, j, k)
        side = int(solids.empty[block])
        reach = abs(side)
        # The last step may have crossed a surface: if it crossed a block, or where the distance of a vessel's cavity
        # jumps above the opening. Otherwise, empty blocks are skipped.
        if reach > 0 and not across and (side < 0) == inside:
            before, at_point = t, math.nan
            t = max(t, end_of_blocks(i, j, k, reach, bx, by, bz, qx, qy, qz)) + beyond
            if t >= leave:
                return False, 0.0, 0.0
            continue
        wall, lowest, highest = t, -math.inf, math.inf
        if reach == 0:
            wall = max(t, end_of_blocks(i, j, k, 1, bx, by, bz, qx, qy, qz))
            lowest, highest = _slope_along(solids.slopes[block], dx, dy, dz)
        while True:
            at_before, at_point = at_point, _distance_at(coefficients, grid, line, t)
            if (at_point < 0.0) != inside:
                start, end = _root(coefficients, grid, line, before, t, at_before, at_point, _ROOT_TOLERANCE * min_step)
                return True, start, end
            if t >= leave:
                return False, 0.0, 0.0
            before, across = t, False
            if reach > 0:
                break
            step = max(abs(at_point), min_step, min(wall - t, _free_length(inside, at_point, lowest, highest)))
            across = (lowest > 0.0 or highest < 0.0) and wall - t > step
            # Slightly beyond the wall, so that the next block is certain despite rounding errors.
            t = min((wall if across else t + step) + beyond, leave)
            if t > wall:
                break


@compiled
def _free_length(inside, distance, lowest, highest):
    """Return a length without surface ahead, from the distance and the bounds of its slope in the current block."""
    # Largest slope towards zero; NaN at the border of the grid, where slopes are unknown.
    towards = highest if inside else -lowest
    if towards <= 0.0:
        return math.inf
    reached = abs(distance) / towards
    return reached if reached >= 0.0 else 0.0
