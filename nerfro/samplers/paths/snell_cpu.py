"""Compiled refraction and reflection at the zero level of signed-distance solids, one thread per ray.

The algorithm is `samplers.paths.snell.trace_interfaces`, for one ray at a time. A *segment* is the straight part of a
polyline between two *events*, refractions or reflections at a surface. If light splits, the transmitted part is
followed first. The reflected part becomes a *pending branch*, which shares the polyline up to the event; pending
branches are followed later, the last one first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8
from numba import prange

from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.lookup import body_distance, box_span, distance_out, grid_of, spline_value_gradient
from nerfro.samplers.paths.surface_search_cpu import Line, advance, first_surface

_BLOCK = 64  # number of rays for which a thread allocates scratch memory once


class Settings(NamedTuple):
    """Settings of the trace, see `samplers.paths.snell.Snell` and `samplers.paths.branching.Branching`."""

    max_events: int
    max_split_events: int  # first events of a polyline at which light may split
    least_weight: float
    main_only: bool


class Branch(NamedTuple):
    """State of a branch of light at the last vertex."""

    line: Line  # the vertex, and the direction in which light leaves the vertex
    s: float  # arc length of the vertex
    weight: float  # share of the light of the ray
    num_vertices: int
    num_events: int


class Event(NamedTuple):
    """Refraction, reflection or splitting of light at a surface."""

    line: Line  # line of the part that is followed first
    reflected: bool  # whether the first part is reflected
    mirrored: Line  # line of the reflected part, which becomes a pending branch if light splits
    share: float  # share of the light in the pending branch; 0 if light does not split


class TracedRows(NamedTuple):
    """Polylines of one ray, one row each (P rows, S vertices); fields as in `types.Path`."""

    positions: Float[np.ndarray, "P S 3"]
    directions: Float[np.ndarray, "P S 3"]
    s: Float[np.ndarray, "P S"]
    body: Int8[np.ndarray, "P S"]
    surface: Int8[np.ndarray, "P S"]
    across: Int8[np.ndarray, "P S"]
    weight: Float[np.ndarray, "P"]
    num_vertices: Int[np.ndarray, "P"]
    num_events: Int[np.ndarray, "P"]
    exceeded: Bool[np.ndarray, "P"]  # whether the limit of events was met


class Pending(NamedTuple):
    """Stack of reflected branches that are followed later (K bodies)."""

    line: Float[np.ndarray, "pending 6"]
    s: Float[np.ndarray, " pending"]
    weight: Float[np.ndarray, " pending"]
    num_vertices: Int[np.ndarray, " pending"]
    num_events: Int[np.ndarray, " pending"]
    surface: Int[np.ndarray, " pending"]  # surface of the reflection
    across: Int[np.ndarray, " pending"]  # body behind this surface
    inside: Bool[np.ndarray, "pending K"]


class Scratch(NamedTuple):
    """Memory of a thread."""

    inside: Bool[np.ndarray, "K"]  # whether the ray is inside each body's surface
    crossings: Float[np.ndarray, "K"]  # see `first_surface`
    pending: Pending


@compiled
def _deciding_body(inside, solids):
    """Return the number of the body that decides at a point, from 1; 0 in air (`media.bodies.Bodies.deciding_body`)."""
    number = 0
    for body in range(len(inside)):
        if inside[body]:
            number = body + 1
        elif solids.nested:
            break
    if solids.nested and number > 0 and solids.iors[number - 1] == 1.0 and not solids.absorbs[number - 1]:
        return 0
    return number


@compiled
def _index(number, solids):
    """Return the refractive index of a body by number from 1; number 0 is air."""
    return solids.iors[number - 1] if number > 0 else 1.0


@compiled
def _absorbs(number, solids):
    """Return whether a body absorbs light, by number from 1; number 0 is air."""
    return number > 0 and solids.absorbs[number - 1]


@compiled
def _transmitted(line, nx, ny, nz, ratio):
    """Refract a line at a surface with a unit normal by Snell's law; returns also whether reflection is total."""
    x, y, z, dx, dy, dz = line
    cosine = -(nx * dx + ny * dy + nz * dz)
    if cosine < 0.0:
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
    squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    if squared <= 0.0:
        return line, True
    along = ratio * cosine - math.sqrt(squared)
    dx, dy, dz = ratio * dx + along * nx, ratio * dy + along * ny, ratio * dz + along * nz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    return Line(x, y, z, dx / norm, dy / norm, dz / norm), False


@compiled
def _reflected(line, nx, ny, nz, ratio):
    """Reflect a line at a surface with a unit normal; returns also the Fresnel reflectance, 1 for total reflection."""
    x, y, z, dx, dy, dz = line
    cosine = -(nx * dx + ny * dy + nz * dz)
    dx, dy, dz = dx + 2.0 * cosine * nx, dy + 2.0 * cosine * ny, dz + 2.0 * cosine * nz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = abs(cosine)
    transmitted = math.sqrt(max(1.0 - ratio * ratio * (1.0 - cosine * cosine), 0.0))
    perpendicular = (ratio * cosine - transmitted) / (ratio * cosine + transmitted)
    parallel = (cosine - ratio * transmitted) / (cosine + ratio * transmitted)
    share = 0.5 * (perpendicular * perpendicular + parallel * parallel)
    return Line(x, y, z, dx / norm, dy / norm, dz / norm), share


@compiled
def _event(solids, hit, line_before, line_behind, ratio, settings, branch):
    """Decide whether light is refracted, reflected or split at a surface.

    Args:
        solids: bodies.
        hit: body whose surface is met.
        line_before, line_behind: arriving line, with its start just before and just behind the surface.
        ratio: ratio of the index before the surface to the index behind the surface.
        settings: settings of the trace.
        branch: arriving branch.
    """
    x, y, z = line_behind.x, line_behind.y, line_behind.z
    _, nx, ny, nz = spline_value_gradient(solids.coefficients, grid_of(solids, hit), x, y, z)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    transmitted, total = _transmitted(line_behind, nx, ny, nz, ratio)
    if not total and branch.num_events >= settings.max_split_events:
        return Event(transmitted, False, transmitted, 0.0)
    mirrored, share = _reflected(line_before, nx, ny, nz, ratio)
    if total:
        return Event(mirrored, True, mirrored, 0.0)
    if branch.weight * min(share, 1.0 - share) >= settings.least_weight:
        return Event(transmitted, False, mirrored, share)
    if share > 0.5:
        return Event(mirrored, True, mirrored, 0.0)
    return Event(transmitted, False, mirrored, 0.0)


@compiled
def _put_vertex(rows, row, branch, body, surface, across):
    """Append the vertex of a branch to a row; beyond the capacity of the row, vertices are only counted."""
    i, line = branch.num_vertices, branch.line
    if i < rows.s.shape[1]:
        position, direction = rows.positions[row, i], rows.directions[row, i]
        position[0], position[1], position[2] = line.x, line.y, line.z
        direction[0], direction[1], direction[2] = line.dx, line.dy, line.dz
        rows.s[row, i] = branch.s
        rows.body[row, i], rows.surface[row, i], rows.across[row, i] = body, surface, across
    return Branch(line, branch.s, branch.weight, i + 1, branch.num_events)


@compiled
def _put_end(solids, rows, row, branch, far, exceeded):
    """Append the last vertex of a row at far; bent paths end outside of the box, beyond far if necessary."""
    line, ahead = branch.line, far - branch.s
    if branch.num_vertices > 1:
        x, y, z, dx, dy, dz = line
        ahead = max(ahead, distance_out(solids.box_low, solids.box_high, x, y, z, dx, dy, dz))
    end = Branch(advance(line, ahead), branch.s + ahead, branch.weight, branch.num_vertices, branch.num_events)
    rows.weight[row], rows.num_events[row], rows.exceeded[row] = branch.weight, branch.num_events, exceeded
    rows.num_vertices[row] = branch.num_vertices + 1
    return _put_vertex(rows, row, end, 0, 0, 0).num_vertices


@compiled
def _push(scratch, size, branch, mirrored, s, weight, surface, across):
    """Put the reflected part of a branch on the stack; returns the size of the stack."""
    pending = scratch.pending
    for i in range(6):
        pending.line[size, i] = mirrored[i]
    pending.s[size], pending.weight[size], pending.surface[size], pending.across[size] = s, weight, surface, across
    pending.num_vertices[size], pending.num_events[size] = branch.num_vertices, branch.num_events + 1
    for body in range(len(scratch.inside)):
        pending.inside[size, body] = scratch.inside[body]
    return size + 1


@compiled
def _resume(solids, scratch, top, rows, former, row):
    """Begin a row with the pending branch on top of the stack.

    Args:
        solids: bodies.
        scratch: memory of the thread, with the stack.
        top: index of the branch on the stack.
        rows: polylines of the ray.
        former: previous row, which shares the vertices before the reflection.
        row: row to begin.
    """
    pending, inside = scratch.pending, scratch.inside
    for body in range(len(inside)):
        inside[body] = pending.inside[top, body]
    count = pending.num_vertices[top]
    for i in range(min(count, rows.s.shape[1])):
        for axis in range(3):
            rows.positions[row, i, axis] = rows.positions[former, i, axis]
            rows.directions[row, i, axis] = rows.directions[former, i, axis]
        rows.s[row, i], rows.body[row, i] = rows.s[former, i], rows.body[former, i]
        rows.surface[row, i], rows.across[row, i] = rows.surface[former, i], rows.across[former, i]
    x, y, z, dx, dy, dz = pending.line[top]
    branch = Branch(Line(x, y, z, dx, dy, dz), pending.s[top], pending.weight[top], count, pending.num_events[top])
    return _put_vertex(rows, row, branch, _deciding_body(inside, solids), pending.surface[top], pending.across[top])


@compiled
def _cross(solids, scratch, body, hit, after):
    """Move a ray to the other side of a surface; returns the body there, and the arc length behind the surface.

    A gap of air between two bodies that is thinner than the shortest step of the search for their surfaces counts as
    closed, so touching bodies need not fit exactly.

    Args:
        solids: bodies.
        scratch: memory of the thread, with the crossings of `first_surface`. They become negative for crossed surfaces,
            as `_flip` needs them.
        body: body before the surface.
        hit: body whose surface is met.
        after: arc length behind this surface.
    """
    inside, crossings = scratch.inside, scratch.crossings
    inside[hit] = not inside[hit]
    across, behind = _deciding_body(inside, solids), after
    crossings[hit] = -1.0
    if across == 0 and body > 0:
        for other in range(len(inside)):
            if 0.0 <= crossings[other] <= after + min(solids.min_step[hit], solids.min_step[other]):
                inside[other] = not inside[other]
                behind = max(behind, crossings[other])
                crossings[other] = -1.0
        across = _deciding_body(inside, solids)
    return across, behind


@compiled
def _flip(scratch):
    """Change the side of all surfaces that `_cross` has crossed."""
    for body in range(len(scratch.inside)):
        if scratch.crossings[body] < 0.0:
            scratch.inside[body] = not scratch.inside[body]


@compiled
def _follow(solids, settings, scratch, rows, row, branch, num_pending):
    """Follow a branch from event to event, until there is no surface ahead or the limit of events is met.

    Returns:
        The branch at the last event, whether the limit was met, and the number of pending branches.
    """
    inside = scratch.inside
    while True:
        here = branch.line
        hit, before, after = first_surface(solids, inside, scratch.crossings, here)
        if hit < 0:
            return branch, False, num_pending
        body = _deciding_body(inside, solids)
        across, behind = _cross(solids, scratch, body, hit, after)
        n_before, n_across = _index(body, solids), _index(across, solids)
        far = advance(here, behind)
        if n_before == n_across:
            branch = Branch(far, branch.s + behind, branch.weight, branch.num_vertices, branch.num_events)
            if body != across and (_absorbs(body, solids) or _absorbs(across, solids)):
                branch = _put_vertex(rows, row, branch, across, hit + 1, across)
            continue
        if branch.num_events >= settings.max_events:
            return branch, True, num_pending
        event = _event(solids, hit, advance(here, before), far, n_before / n_across, settings, branch)
        weight = branch.weight
        if event.share > 0.0:
            if not settings.main_only:
                _flip(scratch)
                s, share = branch.s + before, weight * event.share
                num_pending = _push(scratch, num_pending, branch, event.mirrored, s, share, hit + 1, across)
                _flip(scratch)
            weight *= 1.0 - event.share
        if event.reflected:
            _flip(scratch)
        length = before if event.reflected else behind
        branch = Branch(event.line, branch.s + length, weight, branch.num_vertices, branch.num_events + 1)
        branch = _put_vertex(rows, row, branch, body if event.reflected else across, hit + 1, across)


@compiled
def _trace_ray(solids, line, near, far, settings, scratch, rows):
    """Trace the polylines of one ray into rows; returns the number of polylines and the largest number of vertices.

    Entries after the last vertex of a row are undefined. Polylines beyond the capacity are only counted.
    """
    inside, last_row = scratch.inside, len(rows.weight) - 1
    branch = Branch(advance(line, near), near, 1.0, 0, 0)
    x, y, z, dx, dy, dz = branch.line
    enter, leave = box_span(solids.box_low, solids.box_high, x, y, z, dx, dy, dz)
    misses = not (enter < leave and leave > 0.0 and enter < far - near)
    entry = advance(branch.line, max(enter, 0.0))
    for body in range(len(inside)):
        inside[body] = not misses and body_distance(solids, body, entry.x, entry.y, entry.z) < 0.0
    branch = _put_vertex(rows, 0, branch, _deciding_body(inside, solids), 0, 0)
    if misses:
        return 1, _put_end(solids, rows, 0, branch, far, False)
    branch = Branch(entry, near + max(enter, 0.0), 1.0, branch.num_vertices, 0)
    row, num_polylines, most_vertices, num_pending = 0, 0, 0, 0
    while True:
        branch, exceeded, num_pending = _follow(solids, settings, scratch, rows, row, branch, num_pending)
        num_polylines += 1
        most_vertices = max(most_vertices, _put_end(solids, rows, row, branch, far, exceeded))
        if num_pending == 0:
            return num_polylines, most_vertices
        num_pending -= 1
        former, row = row, min(num_polylines, last_row)
        branch = _resume(solids, scratch, num_pending, rows, former, row)


@compiled_parallel
def trace_snell(origins, directions, near, far, solids, settings, max_vertices, max_polylines):
    """Trace the polylines of all rays, which may split at their first events (`samplers.paths.branching`).

    Args:
        origins, directions, near, far: rays [R, ...].
        solids: bodies, a `kernels.lookup.Solids`.
        settings: settings of the trace.
        max_vertices: largest number of vertices of a polyline, S.
        max_polylines: largest number of polylines of a ray, P.

    Returns:
        rows: `TracedRows` of all rays, with a leading axis R, in the precision of the rays. Entries after the last
            vertex of a polyline are undefined.
        counts [R, 2]: number of polylines of each ray, and largest number of vertices, which may exceed P and S.
    """
    num_rays, dtype = origins.shape[0], origins.dtype
    num_bodies, num_pending = len(solids.iors), settings.max_split_events
    polylines, vertices = (num_rays, max_polylines), (num_rays, max_polylines, max_vertices)
    rows = TracedRows(
        np.empty((*vertices, 3), dtype), np.empty((*vertices, 3), dtype), np.empty(vertices, dtype),
        np.empty(vertices, np.int8), np.empty(vertices, np.int8), np.empty(vertices, np.int8),
        np.empty(polylines, dtype), np.empty(polylines, np.int64),
        np.empty(polylines, np.int64), np.empty(polylines, np.bool_),
    )  # fmt: skip
    counts = np.empty((num_rays, 2), np.int64)
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        pending = Pending(
            np.empty((num_pending, 6)), np.empty(num_pending), np.empty(num_pending), np.empty(num_pending, np.int64),
            np.empty(num_pending, np.int64), np.empty(num_pending, np.int64), np.empty(num_pending, np.int64),
            np.empty((num_pending, num_bodies), np.bool_),
        )  # fmt: skip
        scratch = Scratch(np.empty(num_bodies, np.bool_), np.empty(num_bodies), pending)
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            x, d = origins[ray], directions[ray]
            line = Line(
                np.float64(x[0]), np.float64(x[1]), np.float64(x[2]),
                np.float64(d[0]), np.float64(d[1]), np.float64(d[2]),
            )  # fmt: skip
            row = TracedRows(
                rows.positions[ray], rows.directions[ray], rows.s[ray], rows.body[ray], rows.surface[ray],
                rows.across[ray], rows.weight[ray], rows.num_vertices[ray], rows.num_events[ray], rows.exceeded[ray],
            )  # fmt: skip
            start, end = np.float64(near[ray]), np.float64(far[ray])
            counts[ray] = _trace_ray(solids, line, start, end, settings, scratch, row)
    return rows, counts


@compiled_parallel
def polylines_of_width(rows, ray, place, width):
    """Select polylines with S vertices each; shorter polylines repeat their last vertex.

    Args:
        rows: polylines of all rays, from `trace_snell`.
        ray, place: ray of each selected polyline, and its place among the polylines of the ray.
        width: number of vertices, S.

    Returns:
        positions, directions, s, body, surface and across.
    """
    number, max_vertices, dtype = len(ray), rows.s.shape[2], rows.s.dtype
    positions, directions = np.empty((number, width, 3), dtype), np.empty((number, width, 3), dtype)
    s = np.empty((number, width), dtype)
    body, surface, across = (
        np.empty((number, width), np.int8), np.empty((number, width), np.int8), np.empty((number, width), np.int8)
    )  # fmt: skip
    for p in prange(number):
        r, b = ray[p], place[p]
        last = min(rows.num_vertices[r, b], max_vertices, width) - 1
        for i in range(width):
            j = min(i, last)
            for axis in range(3):
                positions[p, i, axis] = rows.positions[r, b, j, axis]
                directions[p, i, axis] = rows.directions[r, b, j, axis]
            s[p, i], body[p, i] = rows.s[r, b, j], rows.body[r, b, j]
            surface[p, i], across[p, i] = rows.surface[r, b, j], rows.across[r, b, j]
    return positions, directions, s, body, surface, across
