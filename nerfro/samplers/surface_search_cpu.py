"""Search for the first surface on a line, among the zero levels of signed-distance grids."""

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

# Root search ends at this fraction of the shortest step.
_ROOT_TOLERANCE = 1e-6
_BEYOND_WALL = 1e-3  # of the shortest step
_ROOT_ITERATIONS = 60
_SECANTS = 6  # without bisection between them


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
    """Return the line that begins so much further on."""
    x, y, z, dx, dy, dz = line
    return Line(x + length * dx, y + length * dy, z + length * dz, dx, dy, dz)


@compiled
def signed_distance(solids, body, line, t):
    """Return the signed distance to a body's surface at arc length t of a line."""
    x, y, z, dx, dy, dz = line
    return spline_value(solids.values[body], solids.low, solids.inverse_spacing, x + t * dx, y + t * dy, z + t * dz)


@compiled
def _root(solids, body, line, start, end, at_start, at_end, tolerance):
    """Shrink [start, end] around a change of sign (Anderson and Bjorck's method); start keeps its sign, so does end.

    The value at the end is known, that at the start too or not a number. Secants close in from one side until one steps
    over the root; bisection takes turns with them where they do not.
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
            # A step past the root brings the far end in as well.
            middle = min(max(middle, start + 0.25 * tolerance), end - 0.25 * tolerance)
        value = signed_distance(solids, body, line, middle)
        # The end that stays loses weight, or it would stay for ever: as much as the function bends.
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
    """Find the first surface on a line: body (-1 where there is none), and arc lengths before and after it.

    Blocks in which there is no surface are jumped over. In the others steps are as long as the distance to the nearest
    surface, as in sphere tracing, or longer: within a block the distance changes no faster than its slopes there; and
    across a block in which it only grows or only falls, there is at most one surface of each body, between values of
    other signs. `known` is scratch memory: signed distances to the
    bodies at the last two points, and the lowest and highest slopes along the line in the present block.
    """
    x, y, z, dx, dy, dz = line
    _, leave = box_span(solids.low, solids.high, x, y, z, dx, dy, dz)
    small = solids.inverse_small
    # The line in blocks, and how far it goes for one of them.
    rx, ry, rz = dx * small[0], dy * small[1], dz * small[2]
    bx, by, bz = blocks_from(solids.low, small, x, y, z)
    qx, qy, qz = lengths_of_block(rx, ry, rz)
    beyond = _BEYOND_WALL * min_step
    t, before, crossed, across = 0.0, 0.0, False, False
    wall, monotone = 0.0, False
    while not crossed:
        i, j, k = block_at(solids.empty.shape, bx + t * rx, by + t * ry, bz + t * rz)
        reach = solids.empty[i, j, k]
        # Behind a block there may be a surface in it, even where there is none any more.
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
            distance, crossed = _look(solids, inside, known, line, t)
            if crossed:
                break
            if t >= leave:
                return -1, 0.0, 0.0
            before, across = t, False
            if reach > 0:
                break
            step = max(distance, min_step, min(wall - t, _free_length(inside, known)))
            across = monotone and wall - t > step
            # A little beyond the wall, to be in the next block for sure.
            t = min((wall if across else t + step) + beyond, leave)
            if t > wall:
                break
    return _first_crossing(solids, inside, known, line, before, t, _ROOT_TOLERANCE * min_step)


@compiled
def _look(solids, inside, known, line, t):
    """Evaluate the signed distances at arc length t: the least, and whether a surface lies between here and before."""
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
    """Return the length within which no surface can be, by the distances and their slopes in the present block."""
    free = math.inf
    for body in range(len(inside)):
        # The fastest that the value may go to zero; not a number at the border, where nothing is known.
        towards = known[3, body] if inside[body] else -known[2, body]
        if not towards <= 0.0:
            reached = abs(known[1, body]) / towards
            free = min(free, reached) if reached >= 0.0 else 0.0
    return free


@compiled
def _first_crossing(solids, inside, known, line, before, t, tolerance):
    """Find the first of the surfaces that are crossed in a step; returns as `surface_ahead`."""
    hit, hit_before, hit_after = -1, 0.0, math.inf
    for body in range(len(inside)):
        if (known[1, body] < 0.0) != inside[body]:
            first, last = _root(solids, body, line, before, t, known[0, body], known[1, body], tolerance)
            if last < hit_after:
                hit, hit_before, hit_after = body, first, last
    return hit, hit_before, hit_after
