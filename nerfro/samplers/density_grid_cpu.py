"""Compiled kernel of the density-grid sampler: one ray after another, without intermediate tensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import prange

from nerfro.geometry.contraction import FAR, NEAREST
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.philox import fill_uniform

_BLOCK = 64  # rays that share a thread's scratch memory
_THIN = 0.05  # optical depth whose fifth power is nothing in single precision
_DARK = 1e-9  # transmittance behind which nothing is seen
_EPS = float(np.finfo(np.float32).eps)


class Segments(NamedTuple):
    """The segments of one polyline; `closest`, `impact` and `start_length` are set for contracted space alone."""

    cumulative: Float[np.ndarray, "V"]  # measure (arc length or contracted length) at which the segment begins
    start_length: Float[np.ndarray, "V"]  # contracted length from the closest approach to the segment's start
    closest: Float[np.ndarray, "V"]  # arc length of the closest approach to the centre
    impact: Float[np.ndarray, "V"]  # distance from the centre there (impact parameter)


@compiled
def _span(positions, directions, s, low, high):
    """Arc lengths between which one polyline scratch inside a box; both are far where it never does."""
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
    """Find the last vertex strictly before arc length `at`, from `vertex` on."""
    while vertex < len(s) - 1 and s[vertex + 1] < at:
        vertex += 1
    return vertex


@compiled
def _contracted_length(t, impact, radius):
    """Compute `geometry.contraction.contracted_length` of one number."""
    within = np.sqrt(max(radius * radius - impact * impact, 0.0))
    beyond = max(abs(t), within)
    angle = np.arctan2(impact * (beyond - within), impact * impact + beyond * within)
    length = min(abs(t), within) + radius * radius / impact * angle
    return length if t > 0.0 else -length


@compiled
def _world_length(length, impact, radius):
    """Compute `geometry.contraction.world_length` of one number."""
    within = np.sqrt(max(radius * radius - impact * impact, 0.0))
    beyond = abs(length)
    if beyond > within:
        tangent = np.tan((beyond - within) * impact / (radius * radius))
        beyond = impact * (within + impact * tangent) / (impact - within * tangent)
    return beyond if length > 0.0 else -beyond


@compiled
def _contracted_segments(positions, directions, s, centre, radius, near, segments):
    """Fill the segments of `samplers.density_grid.ContractedLength` for one polyline; return its total."""
    cumulative, start_length, closest, impact = segments
    total, last = 0.0, len(s) - 1
    for segment in range(last + 1):
        cumulative[segment] = total
        if 0 < segment < last and s[segment + 1] == s[segment]:
            continue  # a repeated vertex, which fills up the row of the path, begins no segment
        along, square = 0.0, 0.0
        for axis in range(3):
            offset = centre[axis] - positions[segment, axis]
            along += offset * directions[segment, axis]
            square += offset * offset
        impact[segment] = max(np.sqrt(max(square - along * along, 0.0)), NEAREST * radius)
        closest[segment] = s[segment] + along
        start = s[segment] if segment > 0 else min(near, s[1])
        end = s[segment + 1] if segment < last else closest[segment] + FAR * max(impact[segment], radius)
        start_length[segment] = _contracted_length(start - closest[segment], impact[segment], radius)
        total += _contracted_length(end - closest[segment], impact[segment], radius) - start_length[segment]
    return total


@compiled
def _even_segments(s, cumulative):
    """Fill the cumulative lengths where arc length itself is the measure, counted from the camera."""
    for segment in range(len(s)):
        cumulative[segment] = s[segment]


@compiled
def _arc_length(place, segment, segments, radius):
    """Convert a value of the measure within a segment to arc length."""
    if radius == 0.0:
        return place
    length = segments.start_length[segment] + place - segments.cumulative[segment]
    return segments.closest[segment] + _world_length(length, segments.impact[segment], radius)


@compiled
def _contraction_scale(x, y, z, centre, radius):
    """Compute `geometry.contraction.contraction_scale` of one position; 1 where nothing is contracted."""
    if radius == 0.0:
        return 1.0
    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
    return radius * radius / square if square > radius * radius else 1.0


@compiled
def _cell(x, y, z, per_unit, cells):
    """Number of the cell at a position relative to the grid's corner.

    There are `per_unit` cells for each unit of length along each axis, and `cells` cells along each axis.
    """
    i = min(max(int(x * per_unit[0]), 0), cells - 1)
    j = min(max(int(y * per_unit[1]), 0), cells - 1)
    k = min(max(int(z * per_unit[2]), 0), cells - 1)
    # Unsigned, because Numba counts signed indices from the end where they are negative, a test for each access.
    return np.uintp((i * cells + j) * cells + k)


@compiled
def _cell_of(x, y, z, scale, centre, low, per_unit, cells):
    """Number of the cell at a position in world space, which is contracted where `scale` is below 1."""
    if scale < 1.0:
        share = (2.0 - np.sqrt(scale)) * np.sqrt(scale)
        x = centre[0] + share * (x - centre[0])
        y = centre[1] + share * (y - centre[1])
        z = centre[2] + share * (z - centre[2])
    return _cell(x - low[0], y - low[1], z - low[2], per_unit, cells)


@compiled
def _depths_even(positions, directions, s, first, width, low, flat, per_unit, cells, depths):
    """Compute the optical depth of each bin of arc length from `first` on, by the density at its midpoint."""
    segment = 0
    for index in range(len(depths)):
        place = first + (index + 0.5) * width
        segment = _segment(s, segment, place)
        ahead = place - s[segment]
        x = positions[segment, 0] + ahead * directions[segment, 0]
        y = positions[segment, 1] + ahead * directions[segment, 1]
        z = positions[segment, 2] + ahead * directions[segment, 2]
        depths[index] = flat[_cell(x - low[0], y - low[1], z - low[2], per_unit, cells)] * width


@compiled
def _depths_contracted(positions, directions, s, centre, radius, segments, width, flat, per_unit, cells, depths):
    """Compute the optical depth of each bin of contracted length, by the density at its midpoint.

    Outside the ball of radius R, a point of a line with impact parameter a is a tan(phi) away from the closest
    approach, and phi is linear in the contracted length. The point is contracted to
    (2 - R cos(phi) / a) R (e cos(phi) + d sin(phi)), where d is the line's direction and e the unit vector from the
    centre to the closest approach. Therefore one rotation leads from bin to bin, without a square root or a tangent.
    """
    cumulative, start_length, closest, impact = segments
    segment, turned_segment, turned_side, cosine, sine, by_cosine, by_sine = 0, -1, 0, 0.0, 0.0, 0.0, 0.0
    x0, y0, z0, within, a = 0.0, 0.0, 0.0, 0.0, 0.0
    half = 2.0 * radius
    known = -1
    for index in range(len(depths)):
        place = (index + 0.5) * width
        segment = _segment(cumulative, segment, place)
        if segment != known:  # the closest approach relative to the centre
            known, a = segment, impact[segment]
            within = np.sqrt(max(radius * radius - a * a, 0.0))
            x0 = positions[segment, 0] + (closest[segment] - s[segment]) * directions[segment, 0] - centre[0]
            y0 = positions[segment, 1] + (closest[segment] - s[segment]) * directions[segment, 1] - centre[1]
            z0 = positions[segment, 2] + (closest[segment] - s[segment]) * directions[segment, 2] - centre[2]
        length = start_length[segment] + place - cumulative[segment]
        if abs(length) <= within:
            across, along = 1.0, length
        else:
            side = 1 if length > 0.0 else -1
            if segment == turned_segment and side == turned_side:
                cosine, sine = cosine * by_cosine - sine * by_sine, sine * by_cosine + cosine * by_sine
            else:
                turned_segment, turned_side, rate = segment, side, a / (radius * radius)
                angle = side * (np.arctan2(within, a) + (abs(length) - within) * rate)
                cosine, sine = np.cos(angle), np.sin(angle)
                by_cosine, by_sine = np.cos(width * rate), np.sin(width * rate)
            reach = (2.0 - radius / a * cosine) * radius
            across, along = reach * cosine / a, reach * sine
        x = across * x0 + along * directions[segment, 0] + half
        y = across * y0 + along * directions[segment, 1] + half
        z = across * z0 + along * directions[segment, 2] + half
        depths[index] = flat[_cell(x, y, z, per_unit, cells)] * width


@compiled
def _stopped(depth):
    """Compute 1 - exp(-depth) in single precision, for small depths by a series, which most bins need."""
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
    positions, directions, s, low, high, density, ray_index, num_intervals, key, num_samples, num_bins, floor,
    max_bin_alpha, empty, radius, near,
):  # fmt: skip
    """Draw samples in proportion to the weights that the density grid predicts, plus a floor.

    Args:
        positions, directions, s: vertices of the paths [R, S, 3] and [R, S].
        low, high: corners of the grid, [3]; those of contracted space if `radius` is above 0.
        density: densities of the cells, [C, C, C].
        ray_index: index of each path's ray in the random numbers, [R]; without indices, samples are evenly spread.
        num_intervals: number of random samples on each path, [R]; the others have no length.
        key: `Draws.counters` of the random numbers.
        num_samples, num_bins: samples and bins on each path.
        floor: weight that is added to each bin's share of the weights, which sum to one.
        max_bin_alpha: upper bound on the opacity of one bin.
        empty: optical depth from which a sample counts as occupied.
        radius, near: of `DensityGridSampler`; `radius` is 0 for the box alone.

    Returns:
        Edges [R, N + 1], arc lengths [R, N], positions and directions [R, N, 3], whether samples are occupied [R, N],
        and the samples' `lengths` [R, N] and `measure` [R, N + 1].
    """
    num_rays, num_edges = len(s), num_samples + 1
    cells, num_vertices = density.shape[0], s.shape[1]
    edges = np.empty((num_rays, num_edges), np.float32)
    middles = np.empty((num_rays, num_edges - 1), np.float32)
    points = np.empty((num_rays, num_edges - 1, 3), np.float32)
    headings = np.empty((num_rays, num_edges - 1, 3), np.float32)
    occupied = np.empty((num_rays, num_edges - 1), np.bool_)
    lengths = np.empty((num_rays, num_edges - 1), np.float32)
    measure = np.empty((num_rays, num_edges), np.float32)
    flat = density.ravel()
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        scratch, weights = np.empty((4, num_vertices)), np.empty(num_bins, np.float32)
        u = np.empty(num_edges, np.float32)
        segments = Segments(scratch[0], scratch[1], scratch[2], scratch[3])
        centre, per_unit = np.empty(3), np.empty(3)
        for axis in range(3):
            centre[axis] = 0.5 * (low[axis] + high[axis])
            per_unit[axis] = cells / (high[axis] - low[axis])
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            if radius > 0.0:
                first = 0.0
                last = _contracted_segments(positions[ray], directions[ray], s[ray], centre, radius, near, segments)
            else:
                first, last = _span(positions[ray], directions[ray], s[ray], low, high)
                _even_segments(s[ray], segments.cumulative)
            width = (last - first) / num_bins
            if width == 0.0:  # most rays of an image miss the object
                segment = _segment(segments.cumulative, 0, last)
                for axis in range(3):
                    slope = directions[ray, segment, axis]
                    points[ray, :, axis] = positions[ray, segment, axis] + (last - s[ray, segment]) * slope
                    headings[ray, :, axis] = slope
                edges[ray], measure[ray], middles[ray] = last, last, last
                lengths[ray], occupied[ray] = 0.0, False
                continue
            if radius > 0.0:
                _depths_contracted(
                    positions[ray], directions[ray], s[ray], centre, radius, segments, width, flat, per_unit, cells,
                    weights,
                )  # fmt: skip
            else:
                _depths_even(positions[ray], directions[ray], s[ray], first, width, low, flat, per_unit, cells, weights)
            if len(ray_index) == 0:
                _even_quantiles(u)
            else:
                _random_quantiles(u, num_intervals[ray], ray_index[ray], key)
            total, passed = 0.0, 1.0
            for index in range(num_bins):
                stopped = min(_stopped(weights[index]), max_bin_alpha)
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
            before, edge_segment, segment = np.float32(0), 0, 0
            for edge in range(num_edges):
                while index < num_bins - 1 and u[edge] >= below + share:
                    below += share
                    index += 1
                    share = weights[index] / norm
                inside = min(max((u[edge] - below) / share, 0.0), 1.0)
                place = np.float32(first + (index + inside) * width)
                measure[ray, edge] = place
                edge_segment = _segment(segments.cumulative, edge_segment, place)
                edges[ray, edge] = _arc_length(place, edge_segment, segments, radius)
                if edge > 0:
                    middle = 0.5 * (before + place)
                    segment = _segment(segments.cumulative, segment, middle)
                    at = _arc_length(middle, segment, segments, radius)
                    middles[ray, edge - 1] = at
                    ahead = at - s[ray, segment]
                    dx, dy, dz = directions[ray, segment, 0], directions[ray, segment, 1], directions[ray, segment, 2]
                    x = positions[ray, segment, 0] + ahead * dx
                    y = positions[ray, segment, 1] + ahead * dy
                    z = positions[ray, segment, 2] + ahead * dz
                    points[ray, edge - 1, 0], points[ray, edge - 1, 1], points[ray, edge - 1, 2] = x, y, z
                    headings[ray, edge - 1, 0], headings[ray, edge - 1, 1], headings[ray, edge - 1, 2] = dx, dy, dz
                    scale = _contraction_scale(x, y, z, centre, radius)
                    lengths[ray, edge - 1] = (place - before) / scale
                    depth = flat[_cell_of(x, y, z, scale, centre, low, per_unit, cells)] * (place - before)
                    occupied[ray, edge - 1] = depth >= empty
                before = place
    return edges, middles, points, headings, occupied, lengths, measure
