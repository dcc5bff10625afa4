"""Compiled search for the first surface on a line, among the zero levels of signed-distance grids."""

from __future__ import annotations

import math
from typing import NamedTuple

from nerfro.kernels.compilation import compiled
from nerfro.kernels.lookup import (
    block_at,
    blocks_from,
    box_span,
    end_of_blocks,
    lengths_of_block,
    slopes_along,
    spline_value,
)

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
def signed_distance(solids, body, line, t):
    """Return the signed distance to a body's surface at arc length t of a line."""
    x, y, z, dx, dy, dz = line
    return spline_value(solids.values[body], solids.low, solids.inverse_spacing, x + t * dx, y + t * dy, z + t * dz)


@compiled
def _root(solids, body, line, start, end, at_start, at_end, tolerance):
    """Shrink [start, end] around a change of sign by the method of Anderson and Bjorck; both ends keep their signs.

    The value at the end is known; the value at the start is known or NaN. Secants approach the root from one side until
    a secant exceeds the root; if none does, bisection alternates with secants.
    """
    if math.isnan(at_start):
        at_start = signed_distance(solids, body, line, start)
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
        value = signed_distance(solids, body, line, middle)
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
def surface_ahead(solids, inside, known, line, min_step):
    """Find the first surface on a line; returns the body, or -1, and arc lengths before and after the surface.

    Blocks without a surface are skipped. In other blocks, steps are at least as long as the distance to the nearest
    surface, as in sphere tracing. The bounds of the slope in a block allow longer steps. In a block with a monotonic
    distance, each body has at most one surface, between values of opposite sign, so one step crosses the block.

    `known` is scratch memory: signed distances to the bodies at the last two points, and the lowest and highest slopes
    along the line in the current block.
    """
    x, y, z, dx, dy, dz = line
    _, leave = box_span(solids.low, solids.high, x, y, z, dx, dy, dz)
    small = solids.inverse_small
    # Direction and start in units of blocks, and arc lengths for one block along each axis.
    rx, ry, rz = dx * small[0], dy * small[1], dz * small[2]
    bx, by, bz = blocks_from(solids.low, small, x, y, z)
    qx, qy, qz = lengths_of_block(rx, ry, rz)
    beyond = _BEYOND_WALL * min_step
    t, before, crossed, across = 0.0, 0.0, False, False
    wall, monotone = 0.0, False
    while not crossed:
        i, j, k = block_at(solids.empty.shape, bx + t * rx, by + t * ry, bz + t * rz)
        reach = solids.empty[i, j, k]
        # After a step across a block, a surface in this block may be behind an empty block.
        if reach > 0 and not across:
            before = t
            known[1, :] = math.nan
            t = max(t, end_of_blocks(i, j, k, reach, bx, by, bz, qx, qy, qz)) + beyond
            if t >= leave:
                return -1, 0.0, 0.0
            continue
        if reach == 0:
            wall = max(t, end_of_blocks(i, j, k, 1, bx, by, bz, qx, qy, qz))
            monotone = slopes_along(solids.slopes, i, j, k, dx, dy, dz, known[2], known[3])
        while True:
            distance, crossed = _query(solids, inside, known, line, t)
            if crossed:
                break
            if t >= leave:
                return -1, 0.0, 0.0
            before, across = t, False
            if reach > 0:
                break
            step = max(distance, min_step, min(wall - t, _free_length(inside, known)))
            across = monotone and wall - t > step
            # Slightly beyond the wall, so that the next block is certain despite rounding errors.
            t = min((wall if across else t + step) + beyond, leave)
            if t > wall:
                break
    return _first_crossing(solids, inside, known, line, before, t, _ROOT_TOLERANCE * min_step)


@compiled
def _query(solids, inside, known, line, t):
    """Evaluate signed distances at arc length t; returns the least, and whether a surface was crossed."""
    distance, crossed = math.inf, False
    for body in range(len(inside)):
        known[0, body] = known[1, body]
        value = signed_distance(solids, body, line, t)
        known[1, body] = value
        crossed = crossed or (value < 0.0) != inside[body]
        distance = min(distance, abs(value))
    return distance, crossed


@compiled
def _free_length(inside, known):
    """Return a length without surfaces ahead, from the distances and the bounds of slopes in the current block."""
    free = math.inf
    for body in range(len(inside)):
        # Largest slope towards zero; NaN at the border of the grid, where slopes are unknown.
        towards = known[3, body] if inside[body] else -known[2, body]
        if not towards <= 0.0:
            reached = abs(known[1, body]) / towards
            free = min(free, reached) if reached >= 0.0 else 0.0
    return free


@compiled
def _first_crossing(solids, inside, known, line, before, t, tolerance):
    """Find the first surface that is crossed in a step; see `surface_ahead` for the results."""
    hit, hit_before, hit_after = -1, 0.0, math.inf
    for body in range(len(inside)):
        if (known[1, body] < 0.0) != inside[body]:
            first, last = _root(solids, body, line, before, t, known[0, body], known[1, body], tolerance)
            if last < hit_after:
                hit, hit_before, hit_after = body, first, last
    return hit, hit_before, hit_after
