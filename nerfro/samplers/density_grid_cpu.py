"""Drawing samples on paths from a grid of density, one ray after another without intermediate tensors."""

from __future__ import annotations

import numpy as np
from numba import prange

from nerfro.geometry.contraction import FAR, NEAREST
from nerfro.kernels.compilation import compiled, compiled_parallel


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
        marks[run] = total
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
def _shrinkage(position, centre, radius):
    """`geometry.contraction.shrinkage` of one place; 1 where nothing is contracted."""
    square = 0.0
    for axis in range(3):
        square += (position[axis] - centre[axis]) ** 2
    return radius * radius / square if square > radius * radius and radius > 0.0 else 1.0


@compiled
def _contract(position, centre, smaller):
    """`geometry.contraction.contract` of one place, in place."""
    if smaller < 1.0:
        share = np.sqrt(smaller)
        for axis in range(3):
            position[axis] = centre[axis] + (2.0 - share) * share * (position[axis] - centre[axis])


@compiled
def _cell(position, low, high, cells):
    """Number of the grid's cell that a place lies in."""
    cell = 0
    for axis in range(3):
        along = int((position[axis] - low[axis]) / (high[axis] - low[axis]) * cells)
        cell = cell * cells + min(max(along, 0), cells - 1)
    return cell


@compiled_parallel
def draw(positions, directions, s, low, high, density, u, num_bins, floor, empty, radius, near):
    """Edges and middles of samples drawn in proportion to the weights that the density gives, plus a floor.

    `u` are places in the cumulative distribution, ascending on each ray [R, N + 1]; `floor` is the weight that every
    bin has beside its share, which sums to one. With a `radius` above 0 what is beyond it is contracted, and `low` and
    `high` are the corners of the cube around contracted space. Returns edges [R, N + 1], arc lengths [R, N], positions
    and directions [R, N, 3], whether the optical depth there is `empty` or more [R, N], and the samples' `lengths`
    [R, N] and `measure` [R, N + 1].
    """
    num_rays, num_edges = u.shape
    cells, num_runs = density.shape[0], s.shape[1]
    edges = np.empty((num_rays, num_edges), np.float32)
    middles = np.empty((num_rays, num_edges - 1), np.float32)
    points = np.empty((num_rays, num_edges - 1, 3), np.float32)
    headings = np.empty((num_rays, num_edges - 1, 3), np.float32)
    occupied = np.empty((num_rays, num_edges - 1), np.bool_)
    lengths = np.empty((num_rays, num_edges - 1), np.float32)
    measure = np.empty((num_rays, num_edges), np.float32)
    for ray in prange(num_rays):
        runs = np.empty((4, num_runs))
        marks, begin, passing, aside = runs[0], runs[1], runs[2], runs[3]
        centre, here = np.empty(3), np.empty(3)
        for axis in range(3):
            centre[axis] = 0.5 * (low[axis] + high[axis])
        if radius > 0.0:
            first = 0.0
            last = _contracted_runs(
                positions[ray], directions[ray], s[ray], centre, radius, near, marks, begin, passing, aside
            )
        else:
            first, last = _span(positions[ray], directions[ray], s[ray], low, high)
            _even_runs(s[ray], marks)
        width = (last - first) / num_bins
        weights = np.zeros(num_bins, np.float32)
        total, passed, run = 0.0, 1.0, 0
        if width > 0.0:
            for index in range(num_bins):
                place = first + (index + 0.5) * width
                run = _segment(marks, run, place)
                at = _arc_length(place, run, marks, begin, passing, aside, radius)
                for axis in range(3):
                    here[axis] = positions[ray, run, axis] + (at - s[ray, run]) * directions[ray, run, axis]
                _contract(here, centre, _shrinkage(here, centre, radius))
                stopped = 1.0 - np.exp(-density.flat[_cell(here, low, high, cells)] * width)
                weights[index] = passed * stopped
                passed *= 1.0 - stopped
                total += weights[index]
        total = max(total, 1e-6)
        norm = 0.0
        for index in range(num_bins):
            weights[index] = weights[index] / total + floor
            norm += weights[index]
        below, index = 0.0, 0
        share = weights[0] / norm
        before, run_of_edge, run = np.float32(0), 0, 0
        for edge in range(num_edges):
            while index < num_bins - 1 and u[ray, edge] >= below + share:
                below += share
                index += 1
                share = weights[index] / norm
            inside = min(max((u[ray, edge] - below) / share, 0.0), 1.0)
            place = np.float32(first + (index + inside) * width)
            measure[ray, edge] = place
            run_of_edge = _segment(marks, run_of_edge, place)
            edges[ray, edge] = _arc_length(place, run_of_edge, marks, begin, passing, aside, radius)
            if edge > 0:
                middle = 0.5 * (before + place)
                run = _segment(marks, run, middle)
                at = _arc_length(middle, run, marks, begin, passing, aside, radius)
                middles[ray, edge - 1] = at
                for axis in range(3):
                    slope = directions[ray, run, axis]
                    here[axis] = positions[ray, run, axis] + (at - s[ray, run]) * slope
                    points[ray, edge - 1, axis] = here[axis]
                    headings[ray, edge - 1, axis] = slope
                smaller = _shrinkage(here, centre, radius)
                lengths[ray, edge - 1] = (place - before) / smaller
                _contract(here, centre, smaller)
                occupied[ray, edge - 1] = density.flat[_cell(here, low, high, cells)] * (place - before) >= empty
            before = place
    return edges, middles, points, headings, occupied, lengths, measure
