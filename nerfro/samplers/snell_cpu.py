"""Refraction and total reflection at the zero level of signed-distance grids, one thread per ray.

The same algorithm as `samplers.snell.trace_interfaces`, for one ray at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.lookup import (
    block_clearance,
    box_span,
    distance_out,
    put_vertex,
    repeat_last,
    spline_value,
    spline_value_gradient,
)

# Root search ends at this fraction of the shortest step.
_ROOT_TOLERANCE = 1e-6
_ROOT_ITERATIONS = 60


@compiled
def _root(coefficients, low, inverse_spacing, x, y, z, dx, dy, dz, start, end, tolerance):
    """Shrink [start, end] around a change of sign (Illinois method); start keeps its sign, so does end."""
    at_start = spline_value(coefficients, low, inverse_spacing, x + start * dx, y + start * dy, z + start * dz)
    at_end = spline_value(coefficients, low, inverse_spacing, x + end * dx, y + end * dy, z + end * dz)
    start_inside = at_start < 0.0
    weight_start, weight_end = at_start, at_end
    for iteration in range(_ROOT_ITERATIONS):
        if end - start <= tolerance:
            break
        if iteration % 3 == 2 or weight_end == weight_start:
            middle = 0.5 * (start + end)
        else:
            middle = (start * weight_end - end * weight_start) / (weight_end - weight_start)
            # A step past the root brings the far end in as well.
            middle = min(max(middle, start + 0.25 * tolerance), end - 0.25 * tolerance)
        value = spline_value(coefficients, low, inverse_spacing, x + middle * dx, y + middle * dy, z + middle * dz)
        if (value < 0.0) == start_inside:
            start, weight_start = middle, value
            weight_end *= 0.5
        else:
            end, weight_end = middle, value
            weight_start *= 0.5
    return start, end


@compiled
def _innermost(inside):
    """Number of the last body that a point is in, from 1 on; 0 in none."""
    number = 0
    for body in range(len(inside)):
        if inside[body]:
            number = body + 1
    return number


@compiled
def _index(inside, iors):
    """Index of the last body that a point is in, 1 in none."""
    number = _innermost(inside)
    return iors[number - 1] if number > 0 else 1.0


@compiled_parallel
def trace_snell(
    origins,
    directions,
    near,
    far,
    coefficients,
    clearance,
    iors,
    low,
    high,
    inverse_spacing,
    inverse_block,
    min_step,
    max_events,
    capacity,
):
    """Polylines of all rays.

    Returns:
        positions [R, V, 3], directions [R, V, 3], s [R, V]: with V the capacity, in the rays' precision.
        bodies [R, V]: number of the body in which each vertex is left, see `types.Path`.
        counts [R]: vertices of each path, more than the capacity where it did not suffice.
        events [R]: refractions and reflections of each ray.
        exceeded [R]: whether a ray met the limit of events; it goes straight on from there.
    """
    num_rays = origins.shape[0]
    out_positions = np.empty((num_rays, capacity, 3), origins.dtype)
    out_directions = np.empty((num_rays, capacity, 3), origins.dtype)
    out_s = np.empty((num_rays, capacity), origins.dtype)
    bodies = np.zeros((num_rays, capacity), np.int8)
    counts = np.empty(num_rays, np.int64)
    events = np.zeros(num_rays, np.int64)
    exceeded = np.zeros(num_rays, np.bool_)
    num_bodies = coefficients.shape[0]
    tolerance = _ROOT_TOLERANCE * min_step
    for ray in prange(num_rays):
        dx, dy, dz = float(directions[ray, 0]), float(directions[ray, 1]), float(directions[ray, 2])
        s, end = float(near[ray]), float(far[ray])
        x, y, z = origins[ray, 0] + s * dx, origins[ray, 1] + s * dy, origins[ray, 2] + s * dz
        row = (out_positions[ray], out_directions[ray], out_s[ray])
        count = put_vertex(*row, 0, x, y, z, dx, dy, dz, s)
        enter, leave = box_span(low, high, x, y, z, dx, dy, dz)
        if enter < leave and leave > 0.0 and enter < end - s:
            jump = max(enter, 0.0)
            x, y, z, s = x + jump * dx, y + jump * dy, z + jump * dz, s + jump
            inside = np.empty(num_bodies, np.bool_)
            for body in range(num_bodies):
                inside[body] = spline_value(coefficients[body], low, inverse_spacing, x, y, z) < 0.0
            bodies[ray, 0] = _innermost(inside)
            while True:
                _, leave = box_span(low, high, x, y, z, dx, dy, dz)
                t, before, crossed = 0.0, 0.0, False
                while not crossed:
                    free = block_clearance(clearance, low, inverse_block, x + t * dx, y + t * dy, z + t * dz)
                    if free > 2.0 * min_step:
                        before = t
                        t += free
                        if t >= leave:
                            break
                        continue
                    distance = math.inf
                    for body in range(num_bodies):
                        value = spline_value(
                            coefficients[body], low, inverse_spacing, x + t * dx, y + t * dy, z + t * dz
                        )
                        crossed = crossed or (value < 0.0) != inside[body]
                        distance = min(distance, abs(value))
                    if crossed or t >= leave:
                        break
                    before = t
                    t = min(t + max(distance, min_step), leave)
                if not crossed:
                    break
                # The first of the surfaces that were crossed in this step.
                hit, hit_before, hit_after = -1, 0.0, math.inf
                for body in range(num_bodies):
                    value = spline_value(coefficients[body], low, inverse_spacing, x + t * dx, y + t * dy, z + t * dz)
                    if (value < 0.0) != inside[body]:
                        first, last = _root(
                            coefficients[body], low, inverse_spacing, x, y, z, dx, dy, dz, before, t, tolerance
                        )
                        if last < hit_after:
                            hit, hit_before, hit_after = body, first, last
                n_before = _index(inside, iors)
                inside[hit] = not inside[hit]
                n_after = _index(inside, iors)
                if n_before == n_after:
                    x, y, z, s = x + hit_after * dx, y + hit_after * dy, z + hit_after * dz, s + hit_after
                    continue
                if events[ray] >= max_events:
                    exceeded[ray] = True
                    break
                events[ray] += 1
                hx, hy, hz = x + hit_after * dx, y + hit_after * dy, z + hit_after * dz
                _, nx, ny, nz = spline_value_gradient(coefficients[hit], low, inverse_spacing, hx, hy, hz)
                norm = math.sqrt(nx * nx + ny * ny + nz * nz)
                nx, ny, nz = nx / norm, ny / norm, nz / norm
                cosine = -(nx * dx + ny * dy + nz * dz)
                if cosine < 0.0:
                    nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
                ratio = n_before / n_after
                squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
                if squared <= 0.0:
                    inside[hit] = not inside[hit]
                    hit_after = hit_before
                    scale, along = 1.0, 2.0 * cosine
                else:
                    scale, along = ratio, ratio * cosine - math.sqrt(squared)
                x, y, z, s = x + hit_after * dx, y + hit_after * dy, z + hit_after * dz, s + hit_after
                dx, dy, dz = scale * dx + along * nx, scale * dy + along * ny, scale * dz + along * nz
                norm = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / norm, dy / norm, dz / norm
                if count < capacity:
                    bodies[ray, count] = _innermost(inside)
                count = put_vertex(*row, count, x, y, z, dx, dy, dz, s)
        # A bent path ends outside the box, however long it is; far bounds what lies beyond.
        jump = end - s
        if events[ray] > 0:
            jump = max(jump, distance_out(low, high, x, y, z, dx, dy, dz))
        count = put_vertex(*row, count, x + jump * dx, y + jump * dy, z + jump * dz, dx, dy, dz, s + jump)
        counts[ray] = count
        repeat_last(*row, min(count, capacity))
    return out_positions, out_directions, out_s, bodies, counts, events, exceeded
