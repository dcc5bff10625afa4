"""Compiled refraction and reflection at the surfaces of bodies, one thread per ray.

`tests/reference_tracer.py` has the algorithm for all rays at once, in PyTorch. The surfaces are the zero levels of
distance grids, or the triangles of a `TriangleTree`. A *segment* is the straight part of a
polyline between two *events*, refractions or reflections at a surface. If light splits, the transmitted part is
followed first. The reflected part becomes a *pending branch*, which shares the polyline up to the event; pending
branches are followed later, the last one first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int32
from numba import prange

from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.lookup import body_distance, box_span, distance_out, grid_of, spline_value_gradient
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.surface_search_cpu import Line, advance, first_surface
from nerfro.samplers.paths.triangle_search_cpu import FARTHEST, begin_inside, face_normal, first_triangle

_BLOCK = 64  # number of rays for which a thread allocates scratch memory once
_DEPTH = 64  # largest depth of a tree of triangles


class Branch(NamedTuple):
    """State of a branch of light at the last vertex."""

    line: Line  # the vertex, and the direction in which light leaves the vertex
    s: float  # arc length of the vertex
    weight: float  # share of the light of the ray
    num_vertices: int
    num_events: int


class Crossing(NamedTuple):
    """Surface of a vertex, as in `types.OpticalRecord`; the defaults are those of a vertex on no surface."""

    surface: int = 0
    across: int = 0
    triangle: int = -1


class TracedRows(NamedTuple):
    """Polylines of one ray, one row each (P rows, S vertices)."""

    vertices: Float[np.ndarray, "P S 7"]  # position, direction and arc length
    crossed: Int32[np.ndarray, "P S 4"]  # body behind the vertex, and its `Crossing`
    weight: Float[np.ndarray, "P"]
    numbers: Int[np.ndarray, "P 3"]  # number of vertices, number of events, and whether the limit of events was met


class Scratch(NamedTuple):
    """Memory of a thread, with the stack of reflected branches that are followed later (K bodies)."""

    inside: Bool[np.ndarray, "K"]  # whether the ray is inside each body's surface
    crossings: Float[np.ndarray, "K"]  # see `first_surface` and `first_triangle`
    pending: Float[np.ndarray, "pending 8"]  # line, arc length and weight
    pending_numbers: Int[np.ndarray, "pending 5"]  # vertices, events, and `Crossing` of the reflection
    pending_inside: Bool[np.ndarray, "pending K"]
    # For triangles in L layers: the first triangle of each layer on a line, -1 for none, its distance, and nodes of the
    # tree that are searched later, with the distances to their boxes.
    faces: Int[np.ndarray, "L"]
    lengths: Float[np.ndarray, "L"]
    nodes: Int[np.ndarray, " depth"]
    entries: Float[np.ndarray, " depth"]


@compiled
def _deciding_body(inside, solids):
    """Return the number of the body that decides at a point, from 1; 0 in air (`media.bodies.Bodies.deciding_body`)."""
    number = 0
    for body in range(len(inside)):
        if inside[body]:
            number = body + 1
        elif solids.nested:
            break
    return 0 if solids.nested and solids.iors[number] == 1.0 and not solids.absorbs[number] else number


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
def _event(normal, line_before, line_behind, ratio, branching, branch):
    """Decide whether light is refracted, reflected or split at a surface.

    Args:
        normal: unit normal of the surface.
        line_before, line_behind: arriving line, with its start just before and just behind the surface.
        ratio: ratio of the index before the surface to the index behind the surface.
        branching: rule for splitting.
        branch: arriving branch.

    Returns:
        Line of the part that is followed first; whether this part is reflected; line of the reflected part, which
        becomes a pending branch if light splits; and its share of the light, 0 if light does not split.
    """
    nx, ny, nz = normal
    transmitted, total = _transmitted(line_behind, nx, ny, nz, ratio)
    if not total and branch.num_events >= branching.max_split_events:
        return transmitted, False, transmitted, 0.0
    mirrored, share = _reflected(line_before, nx, ny, nz, ratio)
    if total:
        return mirrored, True, mirrored, 0.0
    if branch.weight * min(share, 1.0 - share) >= branching.least_weight:
        return transmitted, False, mirrored, share
    if share > 0.5:
        return mirrored, True, mirrored, 0.0
    return transmitted, False, mirrored, 0.0


@compiled
def _put_vertex(rows, row, branch, body, crossing):
    """Append the vertex of a branch to a row; beyond the capacity of the row, vertices are only counted."""
    i, line = branch.num_vertices, branch.line
    if i < rows.vertices.shape[1]:
        vertex, crossed = rows.vertices[row, i], rows.crossed[row, i]
        for j in range(6):
            vertex[j] = line[j]
        vertex[6] = branch.s
        crossed[0], crossed[1], crossed[2], crossed[3] = body, crossing.surface, crossing.across, crossing.triangle
    return Branch(line, branch.s, branch.weight, i + 1, branch.num_events)


@compiled
def _put_end(solids, rows, row, branch, far, exceeded):
    """Append the last vertex of a row at far; bent paths end outside of the box, beyond far if necessary."""
    line, ahead = branch.line, far - branch.s
    if branch.num_vertices > 1:
        x, y, z, dx, dy, dz = line
        ahead = max(ahead, distance_out(solids.box_low, solids.box_high, x, y, z, dx, dy, dz))
    end = Branch(advance(line, ahead), branch.s + ahead, branch.weight, branch.num_vertices, branch.num_events)
    rows.weight[row], numbers = branch.weight, rows.numbers[row]
    numbers[0], numbers[1], numbers[2] = branch.num_vertices + 1, branch.num_events, exceeded
    return _put_vertex(rows, row, end, 0, Crossing(0, 0, -1)).num_vertices


@compiled
def _push(scratch, size, branch, mirrored, s, weight, crossing):
    """Put the reflected part of a branch on the stack; returns the size of the stack."""
    light, numbers = scratch.pending[size], scratch.pending_numbers[size]
    for i in range(6):
        light[i] = mirrored[i]
    light[6], light[7] = s, weight
    numbers[0], numbers[1] = branch.num_vertices, branch.num_events + 1
    for i in range(3):
        numbers[2 + i] = crossing[i]
    for body in range(len(scratch.inside)):
        scratch.pending_inside[size, body] = scratch.inside[body]
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
    inside = scratch.inside
    for body in range(len(inside)):
        inside[body] = scratch.pending_inside[top, body]
    count, num_events, surface, across, triangle = scratch.pending_numbers[top]
    for i in range(min(count, rows.vertices.shape[1])):
        for j in range(7):
            rows.vertices[row, i, j] = rows.vertices[former, i, j]
        for j in range(4):
            rows.crossed[row, i, j] = rows.crossed[former, i, j]
    x, y, z, dx, dy, dz, s, weight = scratch.pending[top]
    branch = Branch(Line(x, y, z, dx, dy, dz), s, weight, count, num_events)
    return _put_vertex(rows, row, branch, _deciding_body(inside, solids), Crossing(surface, across, triangle))


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
    """Change the side of all surfaces that are crossed."""
    for body in range(len(scratch.inside)):
        if scratch.crossings[body] < 0.0:
            scratch.inside[body] = not scratch.inside[body]


@compiled
def _next_surface(solids, tree, scratch, body, line):
    """Move a ray to the other side of the next surface on a line.

    Args:
        solids: bodies.
        tree: triangles of the bodies; None for the zero levels of the grids.
        scratch: memory of the thread.
        body: body before the surface.
        line: line of the ray.

    Returns:
        Body whose surface is met, -1 for none; its triangle; body on the other side; and arc lengths before and behind
        the surface.
    """
    if tree is None:
        hit, before, after = first_surface(solids, scratch.inside, scratch.crossings, line)
        if hit < 0:
            return hit, -1, 0, before, after
        across, behind = _cross(solids, scratch, body, hit, after)
        return hit, -1, across, before, behind
    scratch.crossings[:] = 1.0
    hit, triangle, before, behind = first_triangle(tree, scratch, line, FARTHEST)
    _flip(scratch)
    across = _deciding_body(scratch.inside, solids)
    if across == 0 and body > 0 and len(scratch.inside) > 1:
        # A thin gap of air between two bodies counts as closed, as in `_cross`.
        _flip(scratch)
        start, limit = advance(line, behind), solids.min_step[hit]
        other, _, _, width = first_triangle(tree, scratch, start, limit)
        if other >= 0:
            if other != hit and width <= solids.min_step[other]:
                behind += width
            else:
                first_triangle(tree, scratch, start, limit)  # changes the signs of the crossings back
        _flip(scratch)
        across = _deciding_body(scratch.inside, solids)
    return hit, triangle, across, before, behind


@compiled
def _normal(solids, tree, hit, triangle, line, far, ratio):
    """Return the unit normal at the next surface.

    Args:
        solids, tree: see `_next_surface`.
        hit, triangle: body whose surface is met, and its triangle.
        line: arriving line.
        far: the line, with its start just behind the surface.
        ratio: ratio of the index before the surface to the index behind it.
    """
    if tree is not None:
        return face_normal(tree, triangle, line, ratio)
    _, nx, ny, nz = spline_value_gradient(solids.coefficients, grid_of(solids, hit), far.x, far.y, far.z)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / norm, ny / norm, nz / norm


@compiled
def _follow(solids, tree, settings, scratch, rows, row, branch, num_pending):
    """Follow a branch from event to event, until there is no surface ahead or the limit of events is met.

    Returns:
        The branch at the last event, whether the limit was met, and the number of pending branches.
    """
    max_events, branching = settings[0], Branching(settings[1], settings[2], settings[3])
    while True:
        here = branch.line
        body = _deciding_body(scratch.inside, solids)
        hit, triangle, across, before, behind = _next_surface(solids, tree, scratch, body, here)
        if hit < 0:
            return branch, False, num_pending
        crossing = Crossing(hit + 1, across, triangle)
        n_before, n_across = solids.iors[body], solids.iors[across]
        far = advance(here, behind)
        if n_before == n_across:
            branch = Branch(far, branch.s + behind, branch.weight, branch.num_vertices, branch.num_events)
            if body != across and (solids.absorbs[body] or solids.absorbs[across]):
                branch = _put_vertex(rows, row, branch, across, crossing)
            continue
        if branch.num_events >= max_events:
            return branch, True, num_pending
        ratio, weight = n_before / n_across, branch.weight
        arriving = advance(here, before)
        normal = _normal(solids, tree, hit, triangle, here, far, ratio)
        line, is_reflected, mirrored, share = _event(normal, arriving, far, ratio, branching, branch)
        if share > 0.0:
            if not branching.main_only:
                _flip(scratch)
                s = branch.s + before
                num_pending = _push(scratch, num_pending, branch, mirrored, s, weight * share, crossing)
                _flip(scratch)
            weight *= 1.0 - share
        if is_reflected:
            _flip(scratch)
        length = before if is_reflected else behind
        branch = Branch(line, branch.s + length, weight, branch.num_vertices, branch.num_events + 1)
        branch = _put_vertex(rows, row, branch, body if is_reflected else across, crossing)


@compiled
def _trace_ray(solids, tree, line, near, far, settings, scratch, rows):
    """Trace the polylines of one ray into rows; returns the number of polylines and the largest number of vertices.

    Entries after the last vertex of a row are undefined. Polylines beyond the capacity are only counted.
    """
    last_row, start = len(rows.weight) - 1, 0.0
    branch = Branch(advance(line, near), near, 1.0, 0, 0)
    x, y, z, dx, dy, dz = branch.line
    enter, leave = box_span(solids.box_low, solids.box_high, x, y, z, dx, dy, dz)
    misses = not (enter < leave and leave > 0.0 and enter < far - near)
    scratch.inside[:] = False
    if tree is not None:
        if not misses and enter < 0.0:
            begin_inside(solids, tree, scratch, branch.line)
    elif not misses:
        start = max(enter, 0.0)
        x, y, z, _, _, _ = advance(branch.line, start)
        for body in range(len(scratch.inside)):
            scratch.inside[body] = body_distance(solids, body, x, y, z) < 0.0
    branch = _put_vertex(rows, 0, branch, _deciding_body(scratch.inside, solids), Crossing(0, 0, -1))
    if misses:
        return 1, _put_end(solids, rows, 0, branch, far, False)
    branch = Branch(advance(branch.line, start), near + start, 1.0, branch.num_vertices, 0)
    row, num_polylines, most_vertices, num_pending = 0, 0, 0, 0
    while True:
        branch, exceeded, num_pending = _follow(solids, tree, settings, scratch, rows, row, branch, num_pending)
        num_polylines += 1
        most_vertices = max(most_vertices, _put_end(solids, rows, row, branch, far, exceeded))
        if num_pending == 0:
            return num_polylines, most_vertices
        num_pending -= 1
        former, row = row, min(num_polylines, last_row)
        branch = _resume(solids, scratch, num_pending, rows, former, row)


@compiled_parallel
def trace_snell(rays, solids, tree, settings, rows, counts):
    """Trace the polylines of all rays, which may split at their first events (`samplers.paths.polylines`).

    Args:
        rays: origins, directions, near and far [R, ...].
        solids: bodies, a `kernels.lookup.Solids`.
        tree: triangles of the bodies, a `TriangleTree`; None for the zero levels of the grids.
        settings: largest number of events of a polyline, and the fields of a `Branching`.
        rows, counts: memory for the results, see `samplers.paths.compiled._traced`.
    """
    origins, directions, near, far = rays
    num_rays, num_bodies, num_pending, num_layers = origins.shape[0], len(solids.low), settings[1], 0
    if tree is not None:
        num_layers = tree.num_layers
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        scratch = Scratch(
            np.empty(num_bodies, np.bool_), np.empty(num_bodies), np.empty((num_pending, 8)),
            np.empty((num_pending, 5), np.int64), np.empty((num_pending, num_bodies), np.bool_),
            np.empty(num_layers, np.int64), np.empty(num_layers), np.empty(_DEPTH, np.int64), np.empty(_DEPTH),
        )  # fmt: skip
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            x, d = origins[ray], directions[ray]
            line = Line(
                np.float64(x[0]), np.float64(x[1]), np.float64(x[2]),
                np.float64(d[0]), np.float64(d[1]), np.float64(d[2]),
            )  # fmt: skip
            row = TracedRows(rows.vertices[ray], rows.crossed[ray], rows.weight[ray], rows.numbers[ray])
            start, end = np.float64(near[ray]), np.float64(far[ray])
            counts[ray] = _trace_ray(solids, tree, line, start, end, settings, scratch, row)


@compiled_parallel
def polylines_of_width(rows, ray, place, width):
    """Select polylines with S vertices each; shorter polylines repeat their last vertex.

    Args:
        rows: polylines of all rays, see `trace_snell`.
        ray, place: ray of each selected polyline, and its place among the polylines of the ray.
        width: number of vertices, S.

    Returns:
        positions, directions, s, body, surface, across and triangle.
    """
    number, max_vertices, dtype = len(ray), rows.vertices.shape[2], rows.vertices.dtype
    positions, directions = np.empty((number, width, 3), dtype), np.empty((number, width, 3), dtype)
    s, crossed = np.empty((number, width), dtype), np.empty((3, number, width), np.int8)
    triangle = np.empty((number, width), np.int32)
    for p in prange(number):
        vertices, bodies = rows.vertices[ray[p], place[p]], rows.crossed[ray[p], place[p]]
        last = min(rows.numbers[ray[p], place[p], 0], max_vertices, width) - 1
        for i in range(width):
            j = min(i, last)
            for axis in range(3):
                positions[p, i, axis], directions[p, i, axis] = vertices[j, axis], vertices[j, 3 + axis]
                crossed[axis, p, i] = bodies[j, axis]
            s[p, i], triangle[p, i] = vertices[j, 6], bodies[j, 3]
    return positions, directions, s, crossed[0], crossed[1], crossed[2], triangle
