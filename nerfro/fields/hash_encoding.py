"""Multi-resolution hash encoding (Mueller et al., Instant Neural Graphics Primitives, 2022, section 3).

`hash_encode_in_torch` runs on GPUs, and is the reference implementation of the compiled kernels for CPUs.

In the forward pass, threads share the points. Each thread processes block by block and level by level, so that the
output of a block stays in the first-level cache and the table of a level in the second-level cache. In the backward
pass, threads share the levels. Two threads never write to the same entry, so the kernel needs no atomic operations and
sums do not depend on the number of threads. Gradients of positions are computed only on demand, with threads sharing
the points. Cells, fractions and the hash of y and z are computed in separate loops, because the compiler turns these
loops into vector instructions, in contrast to loops that fetch table entries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor

from nerfro.kernels.compilation import compiled, compiled_parallel, num_threads, share
from nerfro.kernels.constants import constant
from nerfro.kernels.operators import kernel_with_gradients, operator

# Features per vertex. The compiled kernels assume two, which one 64-bit load fetches.
NUM_FEATURES = 2

# Corners of a cell, x fastest.
_CORNERS = tuple((i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1))

# Factors of the spatial hash (Eqn. 4). The factor of x is 1, so that neighbours in x share a cache line.
HASH_Y, HASH_Z = 2654435761, 805459861

_BLOCK = 512
# Parts that threads of Python share: a number of points in the forward pass, and of levels in the backward pass.
_PART, _LEVEL_PARTS = 16 * _BLOCK, 4
_ONE = np.float32(1)
# Hashes have 32 bits.
_UINT, _Y, _Z = np.uint32, np.uint32(HASH_Y), np.uint32(HASH_Z)


@dataclass(frozen=True)
class GridLevels:
    """Layout of the levels in one table, from coarse to fine.

    A level is dense if (resolution + 1)^3 vertices fit into `size` entries, and hashed otherwise.
    """

    resolutions: tuple[int, ...]  # cells along the side of the unit cube
    sizes: tuple[int, ...]  # entries of each level; a power of two for hashed levels

    @property
    def offsets(self) -> tuple[int, ...]:
        """First entry of each level."""
        return tuple(sum(self.sizes[:level]) for level in range(len(self.sizes)))

    @property
    def num_entries(self) -> int:
        return sum(self.sizes)

    @property
    def dense(self) -> tuple[bool, ...]:
        return tuple((n + 1) ** 3 <= size for n, size in zip(self.resolutions, self.sizes, strict=True))


def grid_levels(num_levels: int, base_resolution: int, finest_resolution: int, log2_table_size: int) -> GridLevels:
    """Return levels with resolutions in geometric progression (Eqns. 2 and 3); a single level is the finest."""
    growth = math.log(finest_resolution / base_resolution) / max(num_levels - 1, 1)
    base_resolution = base_resolution if num_levels > 1 else finest_resolution
    # The small addend prevents the last level from being rounded down to one cell less than requested.
    resolutions = [math.floor(base_resolution * math.exp(level * growth) + 1e-6) for level in range(num_levels)]
    sizes = [min((n + 1) ** 3, 2**log2_table_size) for n in resolutions]
    return GridLevels(tuple(resolutions), tuple(sizes))


def hash_encode_in_torch(
    positions: Float[Tensor, "points 3"], table: Float[Tensor, "T 2"], resolutions: Sequence[int], sizes: Sequence[int]
) -> Float[Tensor, "points F"]:
    """Interpolate the features of every level trilinearly and concatenate them.

    Args:
        positions: positions in the unit cube; others are clamped to the cube. Differentiable within a cell.
        table: entries of all levels. Differentiable.
        resolutions, sizes: see `GridLevels`.
    """
    index, weight = _vertices_in_torch(positions.to(table.dtype), GridLevels(tuple(resolutions), tuple(sizes)))
    # The gradient of index_select is one index_add, whereas that of indexing with brackets sorts all indices.
    features = table.index_select(0, index.flatten()).view(*index.shape, NUM_FEATURES)
    return (features * weight[..., None]).sum(2).flatten(1)


def _vertices_in_torch(
    positions: Float[Tensor, "points 3"], levels: GridLevels
) -> tuple[Int[Tensor, "points L 8"], Float[Tensor, "points L 8"]]:
    """Return table entries and interpolation weights of the eight vertices around each position, for every level."""
    resolution, size, offset = (
        constant(values, positions.device) for values in (levels.resolutions, levels.sizes, levels.offsets)
    )
    is_dense = constant(levels.dense, positions.device, torch.bool)
    corner = constant(_CORNERS, positions.device)
    scaled = positions.clamp(0, 1)[:, None] * resolution[:, None]
    cell = torch.minimum(scaled.long(), resolution[:, None] - 1)
    fraction = scaled - cell
    x, y, z = (cell[:, :, None] + corner).unbind(-1)
    stride = resolution[:, None] + 1
    dense = x + stride * (y + stride * z)
    hashed = (x ^ (y * HASH_Y) ^ (z * HASH_Z)) % size[:, None]
    index = torch.where(is_dense[:, None], dense, hashed) + offset[:, None]
    # The gradient of prod would wait for the device to count zeros.
    along_x, along_y, along_z = torch.where(corner.bool(), fraction[:, :, None], 1 - fraction[:, :, None]).unbind(-1)
    return index, along_x * along_y * along_z


def _encode(
    positions: Float[np.ndarray, "3 points"], table: Float[np.ndarray, "T 2"], resolutions: Int[np.ndarray, "L"],
    sizes: Int[np.ndarray, "L"], features: Float[np.ndarray, "points F"],
) -> None:  # fmt: skip
    num_points = positions.shape[1]

    def encode(part: int) -> None:
        _forward(positions, table, resolutions, sizes, (part * _PART, min((part + 1) * _PART, num_points)), features)

    share(encode, -(-num_points // _PART))


def _gradient_of_table(
    positions: Float[np.ndarray, "3 points"], table: Float[np.ndarray, "T 2"], resolutions: Int[np.ndarray, "L"],
    sizes: Int[np.ndarray, "L"], gradient: Float[np.ndarray, "points F"], of_table: Float[np.ndarray, "T 2"],
) -> None:  # fmt: skip
    threads = num_threads()
    # Threads of Numba share the levels themselves.
    parts = _LEVEL_PARTS if threads == 1 else 1
    share(lambda part: _backward(positions, resolutions, sizes, gradient, (part, parts, threads), of_table), parts)


@compiled
def _layout(resolutions, sizes, level):
    """Return whether a level is dense, its bit mask, its first entry and the first entry of the next level."""
    first = 0
    for coarser in range(level):
        first += sizes[coarser]
    side = resolutions[level] + 1
    return side * side * side <= sizes[level], _UINT(sizes[level] - 1), first, first + sizes[level]


@compiled
def _axis_cells(coordinates, resolution, cells, fractions):
    """Compute cells and fractions within cells of coordinates along one axis of the unit cube."""
    scale, last = np.float32(resolution), _UINT(resolution - 1)
    for p in range(coordinates.shape[0]):
        scaled = min(max(coordinates[p], np.float32(0)), _ONE) * scale
        # Clamped as an unsigned number, because nan becomes the smallest signed integer.
        cell = min(_UINT(np.int32(scaled)), last)
        cells[p], fractions[p] = cell, scaled - np.float32(cell)


@compiled
def _edges(j, k, resolution, dense, low_low, high_low, low_high, high_high):
    """Compute the contribution of y and z to the entries of the cells' four edges along x; `_vertices` adds x."""
    if dense:
        row, plane = _UINT(resolution + 1), _UINT((resolution + 1) * (resolution + 1))
        for p in range(j.shape[0]):
            edge = j[p] * row + k[p] * plane
            low_low[p], high_low[p] = edge, edge + row
            low_high[p], high_high[p] = edge + plane, edge + plane + row
    else:
        for p in range(j.shape[0]):
            y, z = j[p] * _Y, k[p] * _Z
            low_low[p], high_low[p] = y ^ z, (y + _Y) ^ z
            low_high[p], high_high[p] = y ^ (z + _Z), (y + _Y) ^ (z + _Z)


@compiled
def _vertices(i, low_low, high_low, low_high, high_high, dense, mask):
    """Return the entries of a cell's eight vertices in a level, x fastest.

    Sizes of hashed levels are powers of two, so that the remainder is a bit mask.
    """
    # Unsigned, because Numba tests signed indices for negative values at each access.
    index, right = np.uintp, i + _UINT(1)
    if dense:
        a, b, c, d = index(low_low + i), index(high_low + i), index(low_high + i), index(high_high + i)
        e, f, g, h = a + index(1), b + index(1), c + index(1), d + index(1)
    else:
        a, e = index((low_low ^ i) & mask), index((low_low ^ right) & mask)
        b, f = index((high_low ^ i) & mask), index((high_low ^ right) & mask)
        c, g = index((low_high ^ i) & mask), index((low_high ^ right) & mask)
        d, h = index((high_high ^ i) & mask), index((high_high ^ right) & mask)
    return a, e, b, f, c, g, d, h


@compiled
def _locate(positions, start, size, resolution, dense, cells, fractions, edges):
    """Compute cells [3, B], fractions [3, B] and edges [4, B] of a block of B positions [3, points]."""
    for axis in range(3):
        # One row at a time, because Numba treats a block of rows as scattered and emits no vector instructions.
        _axis_cells(positions[axis, start : start + size], resolution, cells[axis], fractions[axis])
    _edges(cells[1], cells[2], resolution, dense, edges[0], edges[1], edges[2], edges[3])


@compiled
def _interpolate(cells, fractions, edges, entries, dense, mask, features, first):
    """Write a block's features of one level into two columns of `features`."""
    for p in range(features.shape[0]):
        i, x, y, z = cells[0, p], fractions[0, p], fractions[1, p], fractions[2, p]
        w0, w1, w2, w3 = (_ONE - y) * (_ONE - z), y * (_ONE - z), (_ONE - y) * z, y * z
        low_low, high_low, low_high, high_high = edges[0, p], edges[1, p], edges[2, p], edges[3, p]
        a, b, c, d, e, f, g, h = _vertices(i, low_low, high_low, low_high, high_high, dense, mask)
        for n in range(2):
            left = w0 * entries[a, n] + w1 * entries[c, n] + w2 * entries[e, n] + w3 * entries[g, n]
            right = w0 * entries[b, n] + w1 * entries[d, n] + w2 * entries[f, n] + w3 * entries[h, n]
            features[p, first + n] = (_ONE - x) * left + x * right


@compiled_parallel
def _forward(positions, table, resolutions, sizes, span, features):
    first, end = span
    for block in prange((end - first + _BLOCK - 1) // _BLOCK):
        start = first + block * _BLOCK
        size = min(end - start, _BLOCK)
        cells, fractions = np.empty((3, size), _UINT), np.empty((3, size), np.float32)
        edges = np.empty((4, size), _UINT)
        for level in range(resolutions.shape[0]):
            is_dense, mask, first_entry, end_entry = _layout(resolutions, sizes, level)
            entries = table[first_entry:end_entry]
            _locate(positions, start, size, resolutions[level], is_dense, cells, fractions, edges)
            # Two calls with a constant each, so that the compiled loop over the points has no branch.
            if is_dense:
                _interpolate(cells, fractions, edges, entries, True, mask, features[start : start + size], 2 * level)
            else:
                _interpolate(cells, fractions, edges, entries, False, mask, features[start : start + size], 2 * level)


@compiled
def _weight_gradient(entries, vertex, first, second):
    """Return the derivative of the loss with respect to the weight of a vertex."""
    return first * entries[vertex, 0] + second * entries[vertex, 1]


@compiled
def _slope(x, y, low_low, high_low, low_high, high_high):
    """Interpolate the differences along a cell's four edges of one axis in the other two axes."""
    return (_ONE - y) * ((_ONE - x) * low_low + x * high_low) + y * ((_ONE - x) * low_high + x * high_high)


@compiled_parallel
def _backward_to_positions(positions, table, resolutions, sizes, gradient, of_positions):
    num_points = positions.shape[1]
    for block in prange((num_points + _BLOCK - 1) // _BLOCK):
        start = block * _BLOCK
        size = min(num_points - start, _BLOCK)
        cells, fractions = np.empty((3, size), _UINT), np.empty((3, size), np.float32)
        edges = np.empty((4, size), _UINT)
        slopes = np.zeros((3, size), np.float32)
        for level in range(resolutions.shape[0]):
            is_dense, mask, first_entry, end_entry = _layout(resolutions, sizes, level)
            scale = np.float32(resolutions[level])
            entries = table[first_entry:end_entry]
            _locate(positions, start, size, resolutions[level], is_dense, cells, fractions, edges)
            for p in range(size):
                first, second = gradient[start + p, 2 * level] * scale, gradient[start + p, 2 * level + 1] * scale
                x, y, z = fractions[0, p], fractions[1, p], fractions[2, p]
                low_low, high_low, low_high, high_high = edges[0, p], edges[1, p], edges[2, p], edges[3, p]
                a, b, c, d, e, f, g, h = _vertices(cells[0, p], low_low, high_low, low_high, high_high, is_dense, mask)
                a, b = _weight_gradient(entries, a, first, second), _weight_gradient(entries, b, first, second)
                c, d = _weight_gradient(entries, c, first, second), _weight_gradient(entries, d, first, second)
                e, f = _weight_gradient(entries, e, first, second), _weight_gradient(entries, f, first, second)
                g, h = _weight_gradient(entries, g, first, second), _weight_gradient(entries, h, first, second)
                slopes[0, p] += _slope(y, z, b - a, d - c, f - e, h - g)
                slopes[1, p] += _slope(x, z, c - a, d - b, g - e, h - f)
                slopes[2, p] += _slope(x, y, e - a, f - b, g - c, h - d)
        for axis in range(3):
            for p in range(size):
                # Positions outside are clamped and therefore have no gradient.
                moves = np.float32(0) <= positions[axis, start + p] <= _ONE
                of_positions[axis, start + p] = slopes[axis, p] if moves else np.float32(0)


@compiled_parallel
def _backward(positions, resolutions, sizes, gradient, division, table):
    num_points, (part, parts, threads) = positions.shape[1], division
    # Levels are distributed in turn, because fine levels cost more than coarse levels.
    for thread in prange(threads):
        cells, fractions = np.empty((3, _BLOCK), _UINT), np.empty((3, _BLOCK), np.float32)
        edges = np.empty((4, _BLOCK), _UINT)
        for start in range(0, num_points, _BLOCK):
            size = min(num_points - start, _BLOCK)
            for level in range(part + parts * thread, resolutions.shape[0], parts * threads):
                is_dense, mask, first_entry, end_entry = _layout(resolutions, sizes, level)
                entries = table[first_entry:end_entry]
                _locate(positions, start, size, resolutions[level], is_dense, cells, fractions, edges)
                for p in range(size):
                    # Read before entries are written, because the compiler cannot exclude that the arrays overlap.
                    both = (gradient[start + p, 2 * level], gradient[start + p, 2 * level + 1])
                    if both[0] == 0 and both[1] == 0:
                        continue
                    i, x, y, z = cells[0, p], fractions[0, p], fractions[1, p], fractions[2, p]
                    w0, w1, w2, w3 = (_ONE - y) * (_ONE - z), y * (_ONE - z), (_ONE - y) * z, y * z
                    low_low, high_low, low_high, high_high = edges[0, p], edges[1, p], edges[2, p], edges[3, p]
                    a, b, c, d, e, f, g, h = _vertices(i, low_low, high_low, low_high, high_high, is_dense, mask)
                    for n in range(2):
                        left, right = (_ONE - x) * both[n], x * both[n]
                        entries[a, n] += w0 * left
                        entries[b, n] += w0 * right
                        entries[c, n] += w1 * left
                        entries[d, n] += w1 * right
                        entries[e, n] += w2 * left
                        entries[f, n] += w2 * right
                        entries[g, n] += w3 * left
                        entries[h, n] += w3 * right


_SCHEMA = "hash_encode(Tensor positions, Tensor table, int[] resolutions, int[] sizes)"
_of_columns = kernel_with_gradients(
    _SCHEMA,
    lambda positions, table, resolutions, sizes: positions.new_empty(positions.shape[1], NUM_FEATURES * len(sizes)),
    _encode,
    {0: _backward_to_positions, 1: _gradient_of_table},
)
hash_encode = operator(
    f"{_SCHEMA} -> Tensor",
    hash_encode_in_torch,
    lambda positions, table, *levels: _of_columns(positions.float().t().contiguous(), table, *levels),
)
