"""Drawing samples on paths from a grid of density, one ray after another without intermediate tensors."""

from __future__ import annotations

import numpy as np
from numba import prange

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


@compiled_parallel
def draw(positions, directions, s, low, high, density, u, num_bins, floor, empty):
    """Edges and midpoints of samples drawn in proportion to the weights that the density gives, plus a floor.

    `u` are places in the cumulative distribution, ascending on each ray [R, N + 1]; `floor` is the weight that every
    bin has beside its share, which sums to one. Returns edges [R, N + 1], arc lengths [R, N], positions and directions
    [R, N, 3], and whether the optical depth there is `empty` or more [R, N].
    """
    num_rays, num_edges = u.shape
    cells = density.shape[0]
    edges = np.empty((num_rays, num_edges), np.float32)
    middles = np.empty((num_rays, num_edges - 1), np.float32)
    points = np.empty((num_rays, num_edges - 1, 3), np.float32)
    headings = np.empty((num_rays, num_edges - 1, 3), np.float32)
    occupied = np.empty((num_rays, num_edges - 1), np.bool_)
    for ray in prange(num_rays):
        first, last = _span(positions[ray], directions[ray], s[ray], low, high)
        width = (last - first) / num_bins
        weights = np.zeros(num_bins, np.float32)
        total, passed, vertex = 0.0, 1.0, 0
        if width > 0.0:
            for index in range(num_bins):
                at = first + (index + 0.5) * width
                vertex = _segment(s[ray], vertex, at)
                cell = 0
                for axis in range(3):
                    here = positions[ray, vertex, axis] + (at - s[ray, vertex]) * directions[ray, vertex, axis]
                    place = int((here - low[axis]) / (high[axis] - low[axis]) * cells)
                    cell = cell * cells + min(max(place, 0), cells - 1)
                stopped = 1.0 - np.exp(-density.flat[cell] * width)
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
        for edge in range(num_edges):
            while index < num_bins - 1 and u[ray, edge] >= below + share:
                below += share
                index += 1
                share = weights[index] / norm
            inside = min(max((u[ray, edge] - below) / share, 0.0), 1.0)
            edges[ray, edge] = first + (index + inside) * width
        vertex = 0
        for sample in range(num_edges - 1):
            at = 0.5 * (edges[ray, sample] + edges[ray, sample + 1])
            vertex = _segment(s[ray], vertex, at)
            middles[ray, sample] = at
            cell = 0
            for axis in range(3):
                slope = directions[ray, vertex, axis]
                here = positions[ray, vertex, axis] + (at - s[ray, vertex]) * slope
                points[ray, sample, axis] = here
                headings[ray, sample, axis] = slope
                place = int((here - low[axis]) / (high[axis] - low[axis]) * cells)
                cell = cell * cells + min(max(place, 0), cells - 1)
            occupied[ray, sample] = density.flat[cell] * (edges[ray, sample + 1] - edges[ray, sample]) >= empty
    return edges, middles, points, headings, occupied
