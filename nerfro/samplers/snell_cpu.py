"""Refraction and total reflection at the zero level of signed-distance grids, one thread per ray.

The same algorithm as `samplers.snell.trace_interfaces`, for one ray at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.lookup import (
    block_at,
    blocks_from,
    box_span,
    end_of_blocks,
    lengths_of_block,
    put_end,
    put_vertex,
    slopes_along,
    spline_value,
    spline_value_gradient,
)

# Root search ends at this fraction of the shortest step.
_ROOT_TOLERANCE = 1e-6
_BEYOND_WALL = 1e-3  # of the shortest step
_BLOCK = 64  # rays that share a thread's scratch memory
_ROOT_ITERATIONS = 60
_SECANTS = 6  # without bisection between them


@compiled
def _root(coefficients, low, inverse_spacing, x, y, z, dx, dy, dz, start, end, at_start, at_end, tolerance):
    """Shrink [start, end] around a change of sign (Anderson and Bjorck's method); start keeps its sign, so does end.

    The value at the end is known, that at the start too or not a number. Secants close in from one side until one steps
    over the root; bisection takes turns with them where they do not.
    """
    if math.isnan(at_start):
        at_start = spline_value(coefficients, low, inverse_spacing, x + start * dx, y + start * dy, z + start * dz)
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
        value = spline_value(coefficients, low, inverse_spacing, x + middle * dx, y + middle * dy, z + middle * dz)
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
def _innermost(inside, solids):
    """Number of the body that a point belongs to, from 1 on; 0 in none (`media.solid`)."""
    number = 0
    for body in range(len(inside)):
        if inside[body]:
            number = body + 1
        elif solids.nested:
            break
    if solids.nested and number > 0 and solids.iors[number - 1] == 1.0:
        return 0
    return number


@compiled
def _index(inside, solids):
    """Index of the body that a point belongs to, 1 in none."""
    number = _innermost(inside, solids)
    return solids.iors[number - 1] if number > 0 else 1.0


@compiled
def _surface_ahead(solids, inside, known, x, y, z, dx, dy, dz, min_step):
    """The first surface on a line: body (-1 where there is none), and arc lengths before and after it.

    Blocks in which there is no surface are jumped over. In the others steps are as long as the distance to the nearest
    surface, as in sphere tracing, or longer: within a block the distance changes no faster than its slopes there; and
    across a block in which it only grows or only falls, there is at most one surface of each body, between values of
    other signs. `known` is scratch memory: values of the bodies at the last two places, and the lowest and highest
    slopes along the line in the present block.
    """
    low, inverse_spacing, splines, bodies = solids.low, solids.inverse_spacing, solids.values, len(inside)
    _, leave = box_span(low, solids.high, x, y, z, dx, dy, dz)
    small = solids.inverse_small
    # The line in blocks, and how far it goes for one of them.
    rx, ry, rz = dx * small[0], dy * small[1], dz * small[2]
    bx, by, bz = blocks_from(low, small, x, y, z)
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
            px, py, pz = x + t * dx, y + t * dy, z + t * dz
            distance = math.inf
            for body in range(bodies):
                known[0, body] = known[1, body]
                value = spline_value(splines[body], low, inverse_spacing, px, py, pz)
                known[1, body] = value
                crossed = crossed or (value < 0.0) != inside[body]
                distance = min(distance, abs(value))
            if crossed:
                break
            if t >= leave:
                return -1, 0.0, 0.0
            before, across = t, False
            if reach > 0:
                break
            free = wall - t
            for body in range(bodies):
                # The fastest that the value may go to zero; not a number at the border, where nothing is known.
                towards = known[3, body] if inside[body] else -known[2, body]
                if not towards <= 0.0:
                    reached = abs(known[1, body]) / towards
                    free = min(free, reached) if reached >= 0.0 else 0.0
            step = max(distance, min_step, free)
            across = monotone and wall - t > step
            # A little beyond the wall, to be in the next block for sure.
            t = min((wall if across else t + step) + beyond, leave)
            if t > wall:
                break
    # The first of the surfaces that were crossed in this step.
    hit, hit_before, hit_after = -1, 0.0, math.inf
    tolerance = _ROOT_TOLERANCE * min_step
    for body in range(bodies):
        if (known[1, body] < 0.0) != inside[body]:
            first, last = _root(
                splines[body], low, inverse_spacing, x, y, z, dx, dy, dz,
                before, t, known[0, body], known[1, body], tolerance,
            )  # fmt: skip
            if last < hit_after:
                hit, hit_before, hit_after = body, first, last
    return hit, hit_before, hit_after


@compiled
def _turned(dx, dy, dz, nx, ny, nz, ratio):
    """Direction after a surface with a gradient of any length, refracted or totally reflected, and which of the two."""
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    cosine = -(nx * dx + ny * dy + nz * dz)
    if cosine < 0.0:
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
    squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    reflected = squared <= 0.0
    scale, along = ratio, ratio * cosine
    if reflected:
        scale, along = 1.0, 2.0 * cosine
    else:
        along -= math.sqrt(squared)
    dx, dy, dz = scale * dx + along * nx, scale * dy + along * ny, scale * dz + along * nz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / norm, dy / norm, dz / norm, reflected


@compiled
def _mirrored(dx, dy, dz, nx, ny, nz, ratio):
    """Direction after reflection at a surface with a gradient of any length, and Fresnel's share of it."""
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    cosine = -(nx * dx + ny * dy + nz * dz)
    mx, my, mz = dx + 2.0 * cosine * nx, dy + 2.0 * cosine * ny, dz + 2.0 * cosine * nz
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    cosine = abs(cosine)
    beyond = math.sqrt(max(1.0 - ratio * ratio * (1.0 - cosine * cosine), 0.0))
    across = (ratio * cosine - beyond) / (ratio * cosine + beyond)
    within = (cosine - ratio * beyond) / (cosine + ratio * beyond)
    return mx / norm, my / norm, mz / norm, 0.5 * (across * across + within * within)


@compiled
def _trace_ray(
    solids, origin, direction, near, far, min_step, max_events, num_splits, least_weight, main_only, scratch, rows
):  # fmt: skip
    """One ray's polylines into its rows: their number, and the largest number of vertices.

    What follows a row's last vertex is left as it is.
    """
    positions, directions, lengths, bodies, weights, events, exceeded = rows
    # `waiting` are parts of the light that are followed later, the last one first: each shares most of the polyline
    # before it.
    inside, known, waiting, waiting_numbers, waiting_inside = scratch
    room = lengths.shape[0]
    dx, dy, dz = float(direction[0]), float(direction[1]), float(direction[2])
    s, end = float(near), float(far)
    x, y, z = origin[0] + s * dx, origin[1] + s * dy, origin[2] + s * dz
    count = put_vertex(positions[0], directions[0], lengths[0], 0, x, y, z, dx, dy, dz, s)
    enter, leave = box_span(solids.low, solids.high, x, y, z, dx, dy, dz)
    if not (enter < leave and leave > 0.0 and enter < end - s):
        weights[0], events[0], exceeded[0] = 1.0, 0, False
        return 1, put_end(
            positions[0], directions[0], lengths[0], count, solids.low, solids.high, False, x, y, z, dx, dy, dz, s, end
        )
    jump = max(enter, 0.0)
    x, y, z, s = x + jump * dx, y + jump * dy, z + jump * dz, s + jump
    for body in range(len(inside)):
        value = spline_value(solids.values[body], solids.low, solids.inverse_spacing, x, y, z)
        inside[body] = value < 0.0
    bodies[0, 0] = _innermost(inside, solids)
    num_events, weight, num_waiting, polyline, most = 0, 1.0, 0, 0, 0
    while True:
        row = min(polyline, room - 1)  # rows beyond the room are counted, not kept
        too_many = False
        while True:
            hit, before, after = _surface_ahead(solids, inside, known, x, y, z, dx, dy, dz, min_step)
            if hit < 0:
                break
            n_before = _index(inside, solids)
            inside[hit] = not inside[hit]
            n_after = _index(inside, solids)
            if n_before == n_after:
                x, y, z, s = x + after * dx, y + after * dy, z + after * dz, s + after
                continue
            if num_events >= max_events:
                too_many = True
                break
            _, nx, ny, nz = spline_value_gradient(
                solids.values[hit], solids.low, solids.inverse_spacing,
                x + after * dx, y + after * dy, z + after * dz,
            )  # fmt: skip
            tx, ty, tz, reflected = _turned(dx, dy, dz, nx, ny, nz, n_before / n_after)
            if num_events < num_splits and not reflected:
                mx, my, mz, share = _mirrored(dx, dy, dz, nx, ny, nz, n_before / n_after)
                if weight * min(share, 1.0 - share) >= least_weight:
                    if not main_only:
                        waiting[num_waiting, 0] = x + before * dx
                        waiting[num_waiting, 1] = y + before * dy
                        waiting[num_waiting, 2] = z + before * dz
                        waiting[num_waiting, 3], waiting[num_waiting, 4], waiting[num_waiting, 5] = mx, my, mz
                        waiting[num_waiting, 6], waiting[num_waiting, 7] = s + before, weight * share
                        waiting_numbers[num_waiting, 0], waiting_numbers[num_waiting, 1] = count, num_events + 1
                        for body in range(len(inside)):
                            waiting_inside[num_waiting, body] = inside[body]
                        waiting_inside[num_waiting, hit] = not inside[hit]
                        num_waiting += 1
                    weight *= 1.0 - share
                elif share > 0.5:
                    tx, ty, tz, reflected = mx, my, mz, True
            num_events += 1
            if reflected:
                inside[hit] = not inside[hit]
                after = before
            x, y, z, s = x + after * dx, y + after * dy, z + after * dz, s + after
            dx, dy, dz = tx, ty, tz
            if count < lengths.shape[1]:
                bodies[row, count] = _innermost(inside, solids)
            count = put_vertex(positions[row], directions[row], lengths[row], count, x, y, z, dx, dy, dz, s)
        count = put_end(
            positions[row], directions[row], lengths[row], count, solids.low, solids.high, num_events > 0,
            x, y, z, dx, dy, dz, s, end,
        )  # fmt: skip
        weights[row], events[row], exceeded[row] = weight, num_events, too_many
        polyline, most = polyline + 1, max(most, count)
        if num_waiting == 0:
            return polyline, most
        num_waiting -= 1
        x, y, z = waiting[num_waiting, 0], waiting[num_waiting, 1], waiting[num_waiting, 2]
        dx, dy, dz = waiting[num_waiting, 3], waiting[num_waiting, 4], waiting[num_waiting, 5]
        s, weight = waiting[num_waiting, 6], waiting[num_waiting, 7]
        count, num_events = waiting_numbers[num_waiting, 0], waiting_numbers[num_waiting, 1]
        for body in range(len(inside)):
            inside[body] = waiting_inside[num_waiting, body]
        before_row, row = row, min(polyline, room - 1)
        for i in range(min(count, lengths.shape[1])):
            for axis in range(3):
                positions[row, i, axis] = positions[before_row, i, axis]
                directions[row, i, axis] = directions[before_row, i, axis]
            lengths[row, i], bodies[row, i] = lengths[before_row, i], bodies[before_row, i]
        if count < lengths.shape[1]:
            bodies[row, count] = _innermost(inside, solids)
        count = put_vertex(positions[row], directions[row], lengths[row], count, x, y, z, dx, dy, dz, s)


@compiled_parallel
def trace_snell(
    origins, directions, near, far, solids, min_step, max_events, num_splits, least_weight, main_only, capacity, room
):
    """Polylines of all rays, which may split at their first events (`samplers.branching`).

    Returns:
        positions [R, B, V, 3], directions [R, B, V, 3], s [R, B, V]: with V the capacity and B the room for a ray's
            polylines, in the rays' precision. There are two vertices more than events; nothing is in the rest.
        bodies [R, B, V]: number of the body in which each vertex is left, see `types.Path`.
        weights [R, B]: share of the ray's light.
        events [R, B]: refractions and reflections.
        exceeded [R, B]: whether the limit of events was met; the polyline goes straight on from there.
        counts [R, 2]: polylines of each ray and the most vertices of one, more than B and V where these do not suffice.
    """
    num_rays, num_bodies = origins.shape[0], solids.values.shape[0]
    out_positions = np.empty((num_rays, room, capacity, 3), origins.dtype)
    out_directions = np.empty((num_rays, room, capacity, 3), origins.dtype)
    out_s = np.empty((num_rays, room, capacity), origins.dtype)
    bodies = np.zeros((num_rays, room, capacity), np.int8)
    weights = np.empty((num_rays, room), origins.dtype)
    events = np.empty((num_rays, room), np.int64)
    exceeded = np.empty((num_rays, room), np.bool_)
    counts = np.empty((num_rays, 2), np.int64)
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        scratch = (
            np.empty(num_bodies, np.bool_), np.empty((4, num_bodies)), np.empty((num_splits, 8)),
            np.empty((num_splits, 2), np.int64), np.empty((num_splits, num_bodies), np.bool_),
        )  # fmt: skip
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            rows = (
                out_positions[ray], out_directions[ray], out_s[ray], bodies[ray], weights[ray], events[ray],
                exceeded[ray],
            )  # fmt: skip
            counts[ray] = _trace_ray(
                solids, origins[ray], directions[ray], near[ray], far[ray],
                min_step, max_events, num_splits, least_weight, main_only, scratch, rows,
            )  # fmt: skip
    return out_positions, out_directions, out_s, bodies, weights, events, exceeded, counts


@compiled_parallel
def polylines_of_width(positions, directions, s, bodies, events, ray, place, width):
    """Vertices [P, W] of polylines `place` of rays `ray`, with the last one repeated where there are fewer.

    Takes what `trace_snell` returns of that name, and returns positions, directions, s and bodies.
    """
    number, capacity = len(ray), s.shape[2]
    out_positions, out_directions = np.empty((number, width, 3), s.dtype), np.empty((number, width, 3), s.dtype)
    out_s, out_bodies = np.empty((number, width), s.dtype), np.zeros((number, width), np.int8)
    for p in prange(number):
        r, b = ray[p], place[p]
        last = min(events[r, b] + 2, capacity, width) - 1
        for i in range(width):
            j = min(i, last)
            for axis in range(3):
                out_positions[p, i, axis] = positions[r, b, j, axis]
                out_directions[p, i, axis] = directions[r, b, j, axis]
            out_s[p, i] = s[r, b, j]
        for i in range(last):
            out_bodies[p, i] = bodies[r, b, i]
    return out_positions, out_directions, out_s, out_bodies
