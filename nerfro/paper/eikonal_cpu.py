"""Compiled integration of the Eikonal equation through voxel grids and bodies with thin shells, one thread per ray.

The algorithms are those of `eikonal`, for one ray at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from nerfro.kernels.compilation import compiled, compiled_parallel, inlined
from nerfro.kernels.lookup import block_at, blocks_from, box_span, distance_out
from nerfro.kernels.tolerances import MIN_COSINE
from nerfro.paper.index_cpu import solid_index, voxel_index
from nerfro.paper.tolerances import MIN_NORMAL_PART, MIN_TURN, REACHED, RESOLVED


@compiled
def _with_length_along(vx, vy, vz, kx, ky, kz, n, varies):
    """Set |v| to n by the component along the kick, under the conditions of `integrators.leapfrog`."""
    kick = kx * kx + ky * ky + kz * kz
    excess = vx * vx + vy * vy + vz * vz - n * n
    if kick == 0.0 or (varies and abs(excess) <= RESOLVED * n * n):
        return vx, vy, vz
    along = (vx * kx + vy * ky + vz * kz) / math.sqrt(kick)
    squared = along * along - excess
    if min(along * along, squared) < MIN_NORMAL_PART * n * n:
        return vx, vy, vz
    change = (math.copysign(math.sqrt(squared), along) - along) / math.sqrt(kick)
    return vx + change * kx, vy + change * ky, vz + change * kz


@inlined
def _drift(ds, x, y, z, vx, vy, vz, n, gx, gy, gz):
    """Take the first half of a leapfrog step; returns the new position, v after half a kick, and dsigma."""
    h = ds / max(n + 0.5 * ds * (gx * vx + gy * vy + gz * vz) / n, 0.5 * n)
    kick = 0.5 * h * n
    px, py, pz = vx + kick * gx, vy + kick * gy, vz + kick * gz
    return x + h * px, y + h * py, z + h * pz, px, py, pz, h


@inlined
def _kick(h, px, py, pz, vx, vy, vz, n, gx, gy, gz):
    """Take the second half of a leapfrog step; returns v after the other half of the kick, with length n."""
    kick = 0.5 * h * n
    px, py, pz = px + kick * gx, py + kick * gy, pz + kick * gz
    varies = gx != 0.0 or gy != 0.0 or gz != 0.0
    return _with_length_along(px, py, pz, px - vx, py - vy, pz - vz, n, varies)


@compiled
def _put_vertex(row, count, x, y, z, dx, dy, dz, length):
    """Append a vertex to a polyline; vertices beyond the capacity are only counted.

    Args:
        row: positions, directions and arc lengths of the polyline.
        count: number of its vertices.
        x, y, z, dx, dy, dz, length: position, direction and arc length of the new vertex.
    """
    positions, directions, s = row
    if count < s.shape[0]:
        positions[count, 0], positions[count, 1], positions[count, 2] = x, y, z
        directions[count, 0], directions[count, 1], directions[count, 2] = dx, dy, dz
        s[count] = length
    return count + 1


@compiled
def _repeat_last(row, count):
    """Fill the rest of a polyline with the last vertex."""
    positions, directions, s = row
    last = min(count, s.shape[0]) - 1
    for i in range(last + 1, s.shape[0]):
        for axis in range(3):
            positions[i, axis], directions[i, axis] = positions[last, axis], directions[last, axis]
        s[i] = s[last]


@compiled
def _march_ray_uniformly(voxels, origin, direction, near, far, num_steps, row):
    """Trace one ray by `integrators.euler` and write its vertices; returns whether the index varied along the path."""
    table, low, inverse_spacing = voxels.table, voxels.low, voxels.inverse_spacing
    vx, vy, vz = float(direction[0]), float(direction[1]), float(direction[2])
    s = float(near)
    x, y, z = origin[0] + s * vx, origin[1] + s * vy, origin[2] + s * vz
    ds = (far - s) / (num_steps - 1)
    n, gx, gy, gz = voxel_index(table, low, inverse_spacing, x, y, z)
    vx, vy, vz = n * vx, n * vy, n * vz
    bent = False
    for step in range(num_steps):
        norm = math.sqrt(vx * vx + vy * vy + vz * vz)
        _put_vertex(row, step, x, y, z, vx / norm, vy / norm, vz / norm, s)
        bent = bent or gx != 0.0 or gy != 0.0 or gz != 0.0
        if step == num_steps - 1:
            break
        x0, y0, z0 = x, y, z
        h = ds / n
        x, y, z = x + h * vx, y + h * vy, z + h * vz
        vx, vy, vz = vx + ds * gx, vy + ds * gy, vz + ds * gz
        n, gx, gy, gz = voxel_index(table, low, inverse_spacing, x, y, z)
        s += math.sqrt((x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2)
    return bent


@compiled_parallel
def march_uniform(origins, directions, near, far, voxels, num_steps):
    """Trace rays through a voxel grid by Euler steps of equal arc length.

    Returns:
        positions [R, S, 3], directions [R, S, 3], s [R, S]: S is the number of steps.
        refracted [R]: whether the index varied along the path.
    """
    num_rays = origins.shape[0]
    out_positions = np.empty((num_rays, num_steps, 3), origins.dtype)
    out_directions = np.empty((num_rays, num_steps, 3), origins.dtype)
    out_s = np.empty((num_rays, num_steps), origins.dtype)
    refracted = np.empty(num_rays, np.bool_)
    for ray in prange(num_rays):
        row = (out_positions[ray], out_directions[ray], out_s[ray])
        refracted[ray] = _march_ray_uniformly(
            voxels, origins[ray], directions[ray], near[ray], far[ray], num_steps, row
        )
    return out_positions, out_directions, out_s, refracted


@compiled
def _box_of(voxels, solids):
    """Return the corners of the medium's box."""
    if len(solids.low) == 0:
        return voxels.low, voxels.high
    return solids.box_low, solids.box_high


@compiled
def _look_up(voxels, solids, x, y, z):
    """Return the index, its gradient, and a lower bound of the distance without a change of the index."""
    if len(solids.low) > 0:
        return solid_index(solids, x, y, z)
    n, gx, gy, gz = voxel_index(voxels.table, voxels.low, voxels.inverse_spacing, x, y, z)
    bx, by, bz = blocks_from(voxels.low, voxels.inverse_spacing, x, y, z)
    return n, gx, gy, gz, float(voxels.clearance[block_at(voxels.clearance.shape, bx, by, bz)])


@compiled
def _step_length(solids, step, dx, dy, dz, gx, gy, gz):
    """Return the length of the next step, which depends on the slant in a shell (`media.bodies.Bodies.step_length`)."""
    if len(solids.low) == 0:
        return step
    slope = math.sqrt(gx * gx + gy * gy + gz * gz)
    if slope == 0.0:
        return step
    return step / max(abs(dx * gx + dy * gy + dz * gz) / slope, MIN_COSINE)


@compiled
def _march_ray(voxels, solids, origin, direction, near, far, settings, row):
    """Trace one ray and write its vertices; returns their number, and whether the index varied."""
    low, high = _box_of(voxels, solids)
    step, tolerance, max_steps = settings
    skip = REACHED * step
    dx, dy, dz = float(direction[0]), float(direction[1]), float(direction[2])
    s, end = float(near), float(far)
    x, y, z = origin[0] + s * dx, origin[1] + s * dy, origin[2] + s * dz
    count, refracted = _put_vertex(row, 0, x, y, z, dx, dy, dz, s), False
    enter, leave = box_span(low, high, x, y, z, dx, dy, dz)
    if enter < leave and leave > 0.0 and enter < end - s:
        # Position, direction and arc length of the last recorded vertex.
        kx, ky, kz, kdx, kdy, kdz, ks = x, y, z, dx, dy, dz, s
        jump = max(enter, 0.0)
        x, y, z, s = x + jump * dx, y + jump * dy, z + jump * dz, s + jump
        n, gx, gy, gz, free = _look_up(voxels, solids, x, y, z)
        vx, vy, vz = n * dx, n * dy, n * dz
        for _ in range(max_steps):
            if free > skip:
                if (dx - kdx) ** 2 + (dy - kdy) ** 2 + (dz - kdz) ** 2 > MIN_TURN:
                    count = _put_vertex(row, count, x, y, z, dx, dy, dz, s)
                    kx, ky, kz, kdx, kdy, kdz, ks = x, y, z, dx, dy, dz, s
                x, y, z, s = x + free * dx, y + free * dy, z + free * dz, s + free
                n, gx, gy, gz, free = _look_up(voxels, solids, x, y, z)
                vx, vy, vz = n * dx, n * dy, n * dz
            else:
                varied = gx != 0.0 or gy != 0.0 or gz != 0.0
                ds = _step_length(solids, step, dx, dy, dz, gx, gy, gz)
                x, y, z, px, py, pz, h = _drift(ds, x, y, z, vx, vy, vz, n, gx, gy, gz)
                s += h * math.sqrt(px * px + py * py + pz * pz)
                refracted = refracted or varied
                n, gx, gy, gz, free = _look_up(voxels, solids, x, y, z)
                vx, vy, vz = _kick(h, px, py, pz, vx, vy, vz, n, gx, gy, gz)
                # A straight step must not change the direction by rounding.
                if varied or gx != 0.0 or gy != 0.0 or gz != 0.0:
                    norm = math.sqrt(vx * vx + vy * vy + vz * vz)
                    dx, dy, dz = vx / norm, vy / norm, vz / norm
                ahead = s - ks
                ex, ey, ez = x - kx - ahead * kdx, y - ky - ahead * kdy, z - kz - ahead * kdz
                if ex * ex + ey * ey + ez * ez > tolerance * tolerance:
                    count = _put_vertex(row, count, x, y, z, dx, dy, dz, s)
                    kx, ky, kz, kdx, kdy, kdz, ks = x, y, z, dx, dy, dz, s
            if x < low[0] or x > high[0] or y < low[1] or y > high[1] or z < low[2] or z > high[2]:
                break
        if (dx - kdx) ** 2 + (dy - kdy) ** 2 + (dz - kdz) ** 2 > MIN_TURN:
            count = _put_vertex(row, count, x, y, z, dx, dy, dz, s)
    ahead = end - s
    if refracted:  # a bent path ends outside of the box
        ahead = max(ahead, distance_out(low, high, x, y, z, dx, dy, dz))
    count = _put_vertex(row, count, x + ahead * dx, y + ahead * dy, z + ahead * dz, dx, dy, dz, s + ahead)
    _repeat_last(row, count)
    return count, refracted


@compiled_parallel
def march_adaptive(origins, directions, near, far, voxels, solids, settings, capacity):
    """Trace rays by steps in regions of varying index, and straight jumps elsewhere.

    A vertex is recorded when the path is more than the tolerance from its last tangent. After the largest number of
    steps, a path continues straight.

    Args:
        origins, directions, near, far: rays [R, ...].
        voxels, solids: the medium, which is one of them; `NO_SOLIDS` beside voxels, and `NO_VOXELS` beside solids.
        settings: length of a step, tolerance, and largest number of steps of a ray.
        capacity: largest number of vertices of a path, V.

    Returns:
        positions [R, S, 3], directions [R, S, 3], s [R, S]: S is the capacity; in the precision of the rays.
        counts [R]: number of vertices of each path, which may be more than the capacity.
        refracted [R]: whether the index varied along the path.
    """
    num_rays = origins.shape[0]
    out_positions = np.empty((num_rays, capacity, 3), origins.dtype)
    out_directions = np.empty((num_rays, capacity, 3), origins.dtype)
    out_s = np.empty((num_rays, capacity), origins.dtype)
    counts = np.empty(num_rays, np.int64)
    refracted = np.empty(num_rays, np.bool_)
    for ray in prange(num_rays):
        row = (out_positions[ray], out_directions[ray], out_s[ray])
        counts[ray], refracted[ray] = _march_ray(
            voxels, solids, origins[ray], directions[ray], near[ray], far[ray], settings, row
        )
    return out_positions, out_directions, out_s, counts, refracted
