"""Drawing samples on paths from a grid of density, one ray after another without intermediate tensors."""

from __future__ import annotations

import numpy as np
from numba import prange

from nerfro.geometry.contraction import FAR, NEAREST
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.philox import fill_uniform

_BLOCK = 64  # rays that share a thread's scratch memory
_THIN = 0.05  # optical depth whose fifth power is nothing in single precision
_DARK = 1e-9  # transmittance behind which nothing is seen
_EPS = float(np.finfo(np.float32).eps)


@compiled
def _span(positions, directions, s, low, high):
    """Arc lengths between which one polyline runs inside a box; both are far where it never does."""
    last_vertex = len(s) - 1
    first, last = s[last_vertex], -np.inf
    for vertex in range(last_vertex):
        enter, leave = 0.0, s[vertex + 1] - s[vertex]
        for axis in range(3):
            start, slope = positions[vertex, axis], directions[vertex, axis]
            if slope == 0.0:
                if start < low[axis] or start > high[axis]:
                    leave = -1.0
                continue
            to_low, to_high = (low[axis] - start) / slope, (high[axis] - start) / slope
            enter = max(enter, min(to_low, to_high))
            leave = min(leave, max(to_low, to_high))
        if enter < leave:
            first = min(first, s[vertex] + enter)
            last = max(last, s[vertex] + leave)
    return first, max(first, last)


@compiled
def _segment(s, vertex, at):
    """The last vertex strictly before arc length `at`, searched onwards from `vertex`."""
    while vertex < len(s) - 1 and s[vertex + 1] < at:
        vertex += 1
    return vertex


@compiled
def _contracted_length(t, aside, radius):
    """`geometry.contraction.contracted_length` of one number."""
    within = np.sqrt(max(radius * radius - aside * aside, 0.0))
    beyond = max(abs(t), within)
    angle = np.arctan2(aside * (beyond - within), aside * aside + beyond * within)
    length = min(abs(t), within) + radius * radius / aside * angle
    return length if t > 0.0 else -length


@compiled
def _world_length(length, aside, radius):
    """`geometry.contraction.world_length` of one number."""
    within = np.sqrt(max(radius * radius - aside * aside, 0.0))
    beyond = abs(length)
    if beyond > within:
        tangent = np.tan((beyond - within) * aside / (radius * radius))
        beyond = aside * (within + aside * tangent) / (aside - within * tangent)
    return beyond if length > 0.0 else -beyond


@compiled
def _contracted_runs(positions, directions, s, centre, radius, near, marks, begin, passing, aside):
    """`samplers.measures.Contracted.of` for one polyline; returns the measure of all."""
    total, last = 0.0, len(s) - 1
    for run in range(last + 1):
        marks[run] = total
        if 0 < run < last and s[run + 1] == s[run]:
            continue  # there are as many vertices in every path; no place lies between those that are left over
        along, square = 0.0, 0.0
        for axis in range(3):
            offset = centre[axis] - positions[run, axis]
            along += offset * directions[run, axis]
            square += offset * offset
        aside[run] = max(np.sqrt(max(square - along * along, 0.0)), NEAREST * radius)
        passing[run] = s[run] + along
        start = s[run] if run > 0 else min(near, s[1])
        end = s[run + 1] if run < last else passing[run] + FAR * max(aside[run], radius)
        begin[run] = _contracted_length(start - passing[run], aside[run], radius)
        total += _contracted_length(end - passing[run], aside[run], radius) - begin[run]
    return total


@compiled
def _even_runs(s, marks):
    """The same where arc length itself is the measure: places are counted from the camera."""
    for run in range(len(s)):
        marks[run] = s[run]


@compiled
def _arc_length(place, run, marks, begin, passing, aside, radius):
    """Arc length at a place of the measure within a run."""
    if radius == 0.0:
        return place
    return passing[run] + _world_length(begin[run] + place - marks[run], aside[run], radius)


@compiled
def _contraction_scale(x, y, z, centre, radius):
    """`geometry.contraction.contraction_scale` of one place; 1 where nothing is contracted."""
    if radius == 0.0:
        return 1.0
    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
    return radius * radius / square if square > radius * radius else 1.0


@compiled
def _cell(x, y, z, per_unit, cells):
    """Number of the grid's cell at a place that is counted from the grid's corner.

    There are `per_unit` cells a unit along each axis, `cells` in all.
    """
    i = min(max(int(x * per_unit[0]), 0), cells - 1)
    j = min(max(int(y * per_unit[1]), 0), cells - 1)
    k = min(max(int(z * per_unit[2]), 0), cells - 1)
    # Unsigned, because Numba counts signed indices from the end where they are negative, a test for each access.
    return np.uintp((i * cells + j) * cells + k)


@compiled
def _cell_of(x, y, z, smaller, centre, low, per_unit, cells):
    """The same of a place of the world, which is contracted where its contraction scale is below 1."""
    if smaller < 1.0:
        share = (2.0 - np.sqrt(smaller)) * np.sqrt(smaller)
        x = centre[0] + share * (x - centre[0])
        y = centre[1] + share * (y - centre[1])
        z = centre[2] + share * (z - centre[2])
    return _cell(x - low[0], y - low[1], z - low[2], per_unit, cells)


@compiled
def _depths_even(positions, directions, s, first, width, low, flat, per_unit, cells, depths):
    """Optical depth of each bin of arc length from `first` on, by the density in its middle."""
    run = 0
    for index in range(len(depths)):
        place = first + (index + 0.5) * width
        run = _segment(s, run, place)
        ahead = place - s[run]
        x = positions[run, 0] + ahead * directions[run, 0]
        y = positions[run, 1] + ahead * directions[run, 1]
        z = positions[run, 2] + ahead * directions[run, 2]
        depths[index] = flat[_cell(x - low[0], y - low[1], z - low[2], per_unit, cells)] * width


@compiled
def _depths_contracted(
    positions, directions, s, centre, radius, marks, begin, passing, aside, width, flat, per_unit, cells, depths
):
    """The same in contracted length.

    Beyond the ball a place is a sin(phi) / cos(phi) along its line, a aside of the centre, and phi grows evenly with
    the contracted length. There it is contracted to (2 - R cos(phi) / a) R (e cos(phi) + d sin(phi)), with e the unit
    vector across the line. So each bin turns the one before, without a root or a tangent.
    """
    run, turned_run, turned_side, cosine, sine, by_cosine, by_sine = 0, -1, 0, 0.0, 0.0, 0.0, 0.0
    x0, y0, z0, within, a = 0.0, 0.0, 0.0, 0.0, 0.0
    half = 2.0 * radius
    known = -1
    for index in range(len(depths)):
        place = (index + 0.5) * width
        run = _segment(marks, run, place)
        if run != known:  # place of the line that is nearest to the centre
            known, a = run, aside[run]
            within = np.sqrt(max(radius * radius - a * a, 0.0))
            x0 = positions[run, 0] + (passing[run] - s[run]) * directions[run, 0] - centre[0]
            y0 = positions[run, 1] + (passing[run] - s[run]) * directions[run, 1] - centre[1]
            z0 = positions[run, 2] + (passing[run] - s[run]) * directions[run, 2] - centre[2]
        length = begin[run] + place - marks[run]
        if abs(length) <= within:
            across, along = 1.0, length
        else:
            side = 1 if length > 0.0 else -1
            if run == turned_run and side == turned_side:
                cosine, sine = cosine * by_cosine - sine * by_sine, sine * by_cosine + cosine * by_sine
            else:
                turned_run, turned_side, rate = run, side, a / (radius * radius)
                angle = side * (np.arctan2(within, a) + (abs(length) - within) * rate)
                cosine, sine = np.cos(angle), np.sin(angle)
                by_cosine, by_sine = np.cos(width * rate), np.sin(width * rate)
            reach = (2.0 - radius / a * cosine) * radius
            across, along = reach * cosine / a, reach * sine
        x = across * x0 + along * directions[run, 0] + half
        y = across * y0 + along * directions[run, 1] + half
        z = across * z0 + along * directions[run, 2] + half
        depths[index] = flat[_cell(x, y, z, per_unit, cells)] * width


@compiled
def _stopped(depth):
    """1 - exp(-depth), in single precision; most bins are next to empty or fog, and need no exponential."""
    if depth < _THIN:
        return depth * (1.0 - depth * (1.0 / 2.0 - depth * (1.0 / 6.0 - depth / 24.0)))
    return 1.0 - np.exp(-depth)


@compiled
def _even_quantiles(u):
    """Fill with values of the cumulative weights, evenly spaced and both ends included."""
    for edge in range(len(u)):
        u[edge] = edge * ((1.0 - _EPS) / (len(u) - 1))


@compiled
def _random_quantiles(u, num_intervals, index, key):
    """Fill with a random value of the cumulative weights in each of `num_intervals` + 1 bins; the last one repeats."""
    fill_uniform(u, index, *key)
    for edge in range(len(u)):
        u[edge] = np.float32(edge + u[edge]) / np.float32(num_intervals + 1) if edge <= num_intervals else u[edge - 1]


@compiled_parallel
def draw(
    positions, directions, s, low, high, density, ray_index, num_intervals, key, num_samples, num_bins, floor, trust,
    empty, radius, near,
):  # fmt: skip
    """Edges and middles of samples drawn in proportion to the weights that the density gives, plus a floor.

    Samples are random, with `num_intervals` [R] out of `num_samples` on each ray and the numbers that `key`
    (`Draws.counters`) gives for its `ray_index` [R]; without indices they are evenly spread. `floor` is the weight that
    every bin has beside its share, which sums to one, and no bin is believed to stop more than `trust`. With a `radius`
    above 0 what is beyond it is contracted, and `low` and `high` are the corners of the cube around contracted space.
    Returns edges [R, N + 1], arc lengths [R, N], positions and directions [R, N, 3], whether the optical depth there is
    `empty` or more [R, N], and the samples' `lengths` [R, N] and `measure` [R, N + 1].
    """
    num_rays, num_edges = len(s), num_samples + 1
    cells, num_runs = density.shape[0], s.shape[1]
    edges = np.empty((num_rays, num_edges), np.float32)
    middles = np.empty((num_rays, num_edges - 1), np.float32)
    points = np.empty((num_rays, num_edges - 1, 3), np.float32)
    headings = np.empty((num_rays, num_edges - 1, 3), np.float32)
    occupied = np.empty((num_rays, num_edges - 1), np.bool_)
    lengths = np.empty((num_rays, num_edges - 1), np.float32)
    measure = np.empty((num_rays, num_edges), np.float32)
    flat = density.ravel()
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        runs, weights = np.empty((4, num_runs)), np.empty(num_bins, np.float32)
        u = np.empty(num_edges, np.float32)
        marks, begin, passing, aside = runs[0], runs[1], runs[2], runs[3]
        centre, per_unit = np.empty(3), np.empty(3)
        for axis in range(3):
            centre[axis] = 0.5 * (low[axis] + high[axis])
            per_unit[axis] = cells / (high[axis] - low[axis])
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            if radius > 0.0:
                first = 0.0
                last = _contracted_runs(
                    positions[ray], directions[ray], s[ray], centre, radius, near, marks, begin, passing, aside
                )
            else:
                first, last = _span(positions[ray], directions[ray], s[ray], low, high)
                _even_runs(s[ray], marks)
            width = (last - first) / num_bins
            if width == 0.0:  # most rays of a picture miss the object
                run = _segment(marks, 0, last)
                for axis in range(3):
                    slope = directions[ray, run, axis]
                    points[ray, :, axis] = positions[ray, run, axis] + (last - s[ray, run]) * slope
                    headings[ray, :, axis] = slope
                edges[ray], measure[ray], middles[ray] = last, last, last
                lengths[ray], occupied[ray] = 0.0, False
                continue
            if radius > 0.0:
                _depths_contracted(
                    positions[ray], directions[ray], s[ray], centre, radius, marks, begin, passing, aside, width,
                    flat, per_unit, cells, weights,
                )  # fmt: skip
            else:
                _depths_even(positions[ray], directions[ray], s[ray], first, width, low, flat, per_unit, cells, weights)
            if len(ray_index) == 0:
                _even_quantiles(u)
            else:
                _random_quantiles(u, num_intervals[ray], ray_index[ray], key)
            total, passed = 0.0, 1.0
            for index in range(num_bins):
                stopped = min(_stopped(weights[index]), trust)
                weights[index] = passed * stopped
                passed *= 1.0 - stopped
                total += weights[index]
                if passed < _DARK:
                    weights[index + 1 :] = 0.0
                    break
            per_total, norm = 1.0 / max(total, 1e-6), 0.0
            for index in range(num_bins):
                weights[index] = weights[index] * per_total + floor
                norm += weights[index]
            below, index = 0.0, 0
            share = weights[0] / norm
            before, run_of_edge, run = np.float32(0), 0, 0
            for edge in range(num_edges):
                while index < num_bins - 1 and u[edge] >= below + share:
                    below += share
                    index += 1
                    share = weights[index] / norm
                inside = min(max((u[edge] - below) / share, 0.0), 1.0)
                place = np.float32(first + (index + inside) * width)
                measure[ray, edge] = place
                run_of_edge = _segment(marks, run_of_edge, place)
                edges[ray, edge] = _arc_length(place, run_of_edge, marks, begin, passing, aside, radius)
                if edge > 0:
                    middle = 0.5 * (before + place)
                    run = _segment(marks, run, middle)
                    at = _arc_length(middle, run, marks, begin, passing, aside, radius)
                    middles[ray, edge - 1] = at
                    ahead = at - s[ray, run]
                    dx, dy, dz = directions[ray, run, 0], directions[ray, run, 1], directions[ray, run, 2]
                    x = positions[ray, run, 0] + ahead * dx
                    y = positions[ray, run, 1] + ahead * dy
                    z = positions[ray, run, 2] + ahead * dz
                    points[ray, edge - 1, 0], points[ray, edge - 1, 1], points[ray, edge - 1, 2] = x, y, z
                    headings[ray, edge - 1, 0], headings[ray, edge - 1, 1], headings[ray, edge - 1, 2] = dx, dy, dz
                    smaller = _contraction_scale(x, y, z, centre, radius)
                    lengths[ray, edge - 1] = (place - before) / smaller
                    depth = flat[_cell_of(x, y, z, smaller, centre, low, per_unit, cells)] * (place - before)
                    occupied[ray, edge - 1] = depth >= empty
                before = place
    return edges, middles, points, headings, occupied, lengths, measure
