"""Compiled kernel of the density-grid sampler: one ray after another, without intermediate tensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import prange

from nerfro.geometry.space import FAR, NEAREST
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.lookup import box_span
from nerfro.kernels.philox import fill_uniform

_BLOCK = 64  # rays that share a thread's scratch memory
_THIN = 0.05  # optical depth up to which four terms of the exponential series are exact in single precision
_DARK = 1e-9  # transmittance behind which nothing is seen
_EPS = float(np.finfo(np.float32).eps)


class Grid(NamedTuple):
    """Grid of densities over a box in world space or, if `radius` is above 0, in contracted space."""

    density: Float[np.ndarray, "C*C*C"]  # per unit of length, row by row
    cells: int  # along each axis
    low: Float[np.ndarray, "3"]  # lowest corner
    high: Float[np.ndarray, "3"]  # highest corner
    centre: Float[np.ndarray, "3"]
    per_unit: Float[np.ndarray, "3"]  # cells per unit of length along each axis
    radius: float  # radius of the ball beyond which space is contracted


class Settings(NamedTuple):
    """Settings of `DensityGridSampler`."""

    num_bins: int
    floor: float  # weight that is added to each bin's share of the weights, which sum to one
    max_bin_alpha: float
    empty: float  # optical depth from which a sample counts as occupied
    radius: float  # 0 for the box alone
    near: float


class Drawn(NamedTuple):
    """Samples on P polylines, or on one polyline without the first axis."""

    edges: Float[np.ndarray, "P N+1"]
    s: Float[np.ndarray, "P N"]  # arc lengths
    positions: Float[np.ndarray, "P N 3"]
    directions: Float[np.ndarray, "P N 3"]
    occupied: Bool[np.ndarray, "P N"]
    lengths: Float[np.ndarray, "P N"]
    contracted_edges: Float[np.ndarray, "P N+1"]


class Segments(NamedTuple):
    """The segments of one polyline; `closest`, `impact` and `start_length` are set for contracted space alone."""

    cumulative: Float[np.ndarray, " segment_ends"]  # arc length or contracted length at the segment's start
    start_length: Float[np.ndarray, "S"]  # contracted length from the closest approach to the segment's start
    closest: Float[np.ndarray, "S"]  # arc length of the closest approach to the centre
    impact: Float[np.ndarray, "S"]  # distance from the centre there (impact parameter)


@compiled
def _span(path, low, high):
    """Return the arc lengths at which one polyline enters and leaves a box; both are far if it misses the box."""
    positions, directions, s = path
    last_vertex = len(s) - 1
    first, last = s[last_vertex], -np.inf
    for vertex in range(last_vertex):
        start, direction = positions[vertex], directions[vertex]
        enter, leave = box_span(low, high, start[0], start[1], start[2], direction[0], direction[1], direction[2])
        enter, leave = max(enter, 0.0), min(leave, s[vertex + 1] - s[vertex])
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
    """Compute `geometry.space.contracted_length` of one number."""
    within = np.sqrt(max(radius * radius - impact * impact, 0.0))
    beyond = max(abs(t), within)
    angle = np.arctan2(impact * (beyond - within), impact * impact + beyond * within)
    length = min(abs(t), within) + radius * radius / impact * angle
    return length if t > 0.0 else -length


@compiled
def _world_length(length, impact, radius):
    """Compute `geometry.space.world_length` of one number."""
    within = np.sqrt(max(radius * radius - impact * impact, 0.0))
    beyond = abs(length)
    if beyond > within:
        tangent = np.tan((beyond - within) * impact / (radius * radius))
        beyond = impact * (within + impact * tangent) / (impact - within * tangent)
    return beyond if length > 0.0 else -beyond


@compiled
def _contracted_segments(path, centre, radius, near, segments):
    """Fill the segments of `geometry.space.Contracted.measure` for one polyline; return its total."""
    positions, directions, s = path
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
def _arc_length(place, segment, segments, radius):
    """Convert a cumulative length within a segment to arc length."""
    if radius == 0.0:
        return place
    length = segments.start_length[segment] + place - segments.cumulative[segment]
    return segments.closest[segment] + _world_length(length, segments.impact[segment], radius)


@compiled
def _contraction_scale(x, y, z, centre, radius):
    """Compute `Space.scale` of one position."""
    if radius == 0.0:
        return 1.0
    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
    return radius * radius / square if square > radius * radius else 1.0


@compiled
def _density(x, y, z, grid):
    """Look up the density at a position relative to the grid's lowest corner."""
    last = grid.cells - 1
    i = min(max(int(x * grid.per_unit[0]), 0), last)
    j = min(max(int(y * grid.per_unit[1]), 0), last)
    k = min(max(int(z * grid.per_unit[2]), 0), last)
    # Unsigned, because Numba counts signed indices from the end where they are negative, a test for each access.
    return grid.density[np.uintp((i * grid.cells + j) * grid.cells + k)]


@compiled
def _density_in_world(x, y, z, scale, grid):
    """Look up the density at a position in world space, which is contracted where `scale` is below 1."""
    centre, low = grid.centre, grid.low
    if scale < 1.0:
        share = (2.0 - np.sqrt(scale)) * np.sqrt(scale)
        x = centre[0] + share * (x - centre[0])
        y = centre[1] + share * (y - centre[1])
        z = centre[2] + share * (z - centre[2])
    return _density(x - low[0], y - low[1], z - low[2], grid)


@compiled
def _depths_even(path, grid, first, width, depths):
    """Compute the optical depth of each bin of arc length from `first` on, by the density at its midpoint."""
    positions, directions, s = path
    low, segment = grid.low, 0
    for index in range(len(depths)):
        place = first + (index + 0.5) * width
        segment = _segment(s, segment, place)
        ahead = place - s[segment]
        x = positions[segment, 0] + ahead * directions[segment, 0]
        y = positions[segment, 1] + ahead * directions[segment, 1]
        z = positions[segment, 2] + ahead * directions[segment, 2]
        depths[index] = _density(x - low[0], y - low[1], z - low[2], grid) * width


@compiled
def _depths_contracted(path, grid, segments, width, depths):
    """Compute the optical depth of each bin of contracted length, by the density at its midpoint.

    Outside the ball of radius R, a point of a line with impact parameter a is a tan(phi) away from the closest
    approach, and phi is linear in the contracted length. The point is contracted to
    (2 - R cos(phi) / a) R (e cos(phi) + d sin(phi)), where d is the line's direction and e the unit vector from the
    centre to the closest approach. Therefore one rotation leads from bin to bin, without a square root or a tangent.
    """
    positions, directions, s = path
    centre, radius = grid.centre, grid.radius
    cumulative, start_length, closest, impact = segments
    segment, turned_segment, turned_side, cosine, sine, by_cosine, by_sine = 0, -1, 0, 0.0, 0.0, 0.0, 0.0
    x0, y0, z0, within, a = 0.0, 0.0, 0.0, 0.0, 0.0
    half = 2.0 * radius
    cached_segment = -1
    for index in range(len(depths)):
        place = (index + 0.5) * width
        segment = _segment(cumulative, segment, place)
        if segment != cached_segment:  # the closest approach relative to the centre
            cached_segment, a = segment, impact[segment]
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
        depths[index] = _density(x, y, z, grid) * width


@compiled
def _alpha(optical_depth):
    """Compute the opacity of an interval, 1 - exp(-optical_depth), in single precision.

    Most bins have small optical depths, for which a series is used.
    """
    if optical_depth < _THIN:
        return optical_depth * (1.0 - optical_depth * (1.0 / 2.0 - optical_depth * (1.0 / 6.0 - optical_depth / 24.0)))
    return 1.0 - np.exp(-optical_depth)


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


@compiled
def _bin_weights(weights, settings):
    """Convert optical depths of the bins, in place, to the share of the samples that each bin receives."""
    total, transmittance = 0.0, 1.0
    for index in range(len(weights)):
        optical_depth = weights[index]
        alpha = min(_alpha(optical_depth), settings.max_bin_alpha)
        weights[index] = transmittance * alpha
        transmittance *= 1.0 - alpha
        total += weights[index]
        if transmittance < _DARK:
            weights[index + 1 :] = 0.0
            break
    per_total, norm = 1.0 / max(total, 1e-6), 0.0
    for index in range(len(weights)):
        weights[index] = weights[index] * per_total + settings.floor
        norm += weights[index]
    for index in range(len(weights)):
        weights[index] /= norm


@compiled
def _predict(path, grid, settings, segments, weights):
    """Fill the segments of a path and the weights of its bins.

    Returns:
        The cumulative length at which the first bin begins, and the width of a bin; 0 if the path misses the box.
    """
    if grid.radius > 0.0:
        first = 0.0
        last = _contracted_segments(path, grid.centre, grid.radius, settings.near, segments)
    else:
        first, last = _span(path, grid.low, grid.high)
        for segment, s in enumerate(path[2]):  # arc length from the camera
            segments.cumulative[segment] = s
    width = (last - first) / len(weights)
    if width > 0.0:
        if grid.radius > 0.0:
            _depths_contracted(path, grid, segments, width, weights)
        else:
            _depths_even(path, grid, first, width, weights)
        _bin_weights(weights, settings)
    return first, width


@compiled
def _put_no_samples(path, segments, at, drawn):
    """Place all samples of a path that misses the box at one arc length, without length."""
    positions, directions, s = path
    segment = _segment(segments.cumulative, 0, at)
    for axis in range(3):
        slope = directions[segment, axis]
        drawn.positions[:, axis] = positions[segment, axis] + (at - s[segment]) * slope
        drawn.directions[:, axis] = slope
    drawn.edges[:], drawn.contracted_edges[:], drawn.s[:] = at, at, at
    drawn.lengths[:], drawn.occupied[:] = 0.0, False


@compiled
def _put_samples(path, grid, segments, bins, u, empty, drawn):
    """Place the edges of samples at the values `u` of the cumulative weights, and the samples between them."""
    positions, directions, s = path
    first, width, weights = bins
    below, index = 0.0, 0
    before, edge_segment, segment = np.float32(0), 0, 0
    for edge in range(len(u)):
        while index < len(weights) - 1 and u[edge] >= below + weights[index]:
            below += weights[index]
            index += 1
        inside = min(max((u[edge] - below) / weights[index], 0.0), 1.0)
        place = np.float32(first + (index + inside) * width)
        drawn.contracted_edges[edge] = place
        edge_segment = _segment(segments.cumulative, edge_segment, place)
        drawn.edges[edge] = _arc_length(place, edge_segment, segments, grid.radius)
        if edge > 0:
            middle = 0.5 * (before + place)
            segment = _segment(segments.cumulative, segment, middle)
            at = _arc_length(middle, segment, segments, grid.radius)
            drawn.s[edge - 1] = at
            ahead = at - s[segment]
            dx, dy, dz = directions[segment, 0], directions[segment, 1], directions[segment, 2]
            x = positions[segment, 0] + ahead * dx
            y = positions[segment, 1] + ahead * dy
            z = positions[segment, 2] + ahead * dz
            drawn.positions[edge - 1, 0], drawn.positions[edge - 1, 1], drawn.positions[edge - 1, 2] = x, y, z
            drawn.directions[edge - 1, 0], drawn.directions[edge - 1, 1], drawn.directions[edge - 1, 2] = dx, dy, dz
            scale = _contraction_scale(x, y, z, grid.centre, grid.radius)
            drawn.lengths[edge - 1] = (place - before) / scale
            depth = _density_in_world(x, y, z, scale, grid) * (place - before)
            drawn.occupied[edge - 1] = depth >= empty
        before = place


@compiled_parallel
def draw(paths, box, density, random, num_samples, settings):
    """Draw samples in proportion to the weights that the density grid predicts, plus a floor.

    Args:
        paths: positions [P, S, 3], directions [P, S, 3] and arc lengths [P, S] of the vertices of P polylines.
        box: lowest and highest corner of the grid; those of contracted space if `settings.radius` is above 0.
        density: densities of the cells, [C, C, C].
        random: index of each path's ray in the random numbers [P], number of random samples on each path [P], and
            `Draws.counters`. Without indices, samples are evenly spread.
        num_samples: number of samples on each path; beyond the number of random samples, they have no length.
        settings: the `Settings`.

    Returns:
        The fields of `Drawn`.
    """
    positions, directions, s = paths
    ray_index, num_intervals, key = random
    num_rays, num_vertices, cells = s.shape[0], s.shape[1], density.shape[0]
    edges = np.empty((num_rays, num_samples + 1), np.float32)
    at = np.empty((num_rays, num_samples), np.float32)
    sample_positions = np.empty((num_rays, num_samples, 3), np.float32)
    sample_directions = np.empty((num_rays, num_samples, 3), np.float32)
    occupied = np.empty((num_rays, num_samples), np.bool_)
    lengths = np.empty((num_rays, num_samples), np.float32)
    contracted_edges = np.empty((num_rays, num_samples + 1), np.float32)
    low, high = box
    centre, per_unit = np.empty(3), np.empty(3)
    for axis in range(3):
        centre[axis] = 0.5 * (low[axis] + high[axis])
        per_unit[axis] = cells / (high[axis] - low[axis])
    grid = Grid(density.ravel(), cells, low, high, centre, per_unit, settings.radius)
    for block in prange((num_rays + _BLOCK - 1) // _BLOCK):
        scratch, weights = np.empty((4, num_vertices)), np.empty(settings.num_bins, np.float32)
        segments, u = Segments(scratch[0], scratch[1], scratch[2], scratch[3]), np.empty(num_samples + 1, np.float32)
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, num_rays)):
            path = positions[ray], directions[ray], s[ray]
            drawn = Drawn(
                edges[ray], at[ray], sample_positions[ray], sample_directions[ray],
                occupied[ray], lengths[ray], contracted_edges[ray],
            )  # fmt: skip
            first, width = _predict(path, grid, settings, segments, weights)
            if width == 0.0:  # most rays of an image miss the object
                _put_no_samples(path, segments, first, drawn)
                continue
            if len(ray_index) == 0:
                _even_quantiles(u)
            else:
                _random_quantiles(u, num_intervals[ray], ray_index[ray], key)
            _put_samples(path, grid, segments, (first, width, weights), u, settings.empty, drawn)
    return edges, at, sample_positions, sample_directions, occupied, lengths, contracted_edges
