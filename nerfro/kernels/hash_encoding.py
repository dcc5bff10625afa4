"""Compiled CPU kernels of the hash encoding; `nerfro.fields.hash_encoding` is their reference.

Forward, threads share the points; each thread takes them block by block and level by level, so that a block's output
stays in the first-level cache and a level's table in the second. Backward, threads share the levels: no two threads
write to the same entry, so there are no atomics, and the sums do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfro.fields.hash_encoding import HASH_Y, HASH_Z, NUM_FEATURES, GridLevels
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.threads import use_threads

_BLOCK = 1024
_ONE = np.float32(1)


def hash_encode(
    positions: Float[Tensor, "P 3"], table: Float[Tensor, "T 2"], levels: GridLevels
) -> Float[Tensor, "P 2*L"]:
    """The same as `nerfro.fields.hash_encoding.hash_encode`, on the CPU."""
    return _HashEncode.apply(positions.detach().float().contiguous(), table, levels)


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, positions: Float[Tensor, "P 3"], table: Float[Tensor, "T 2"], levels: GridLevels
    ) -> Float[Tensor, "P 2*L"]:
        ctx.save_for_backward(positions)
        ctx.levels, ctx.num_entries = levels, table.shape[0]
        features = positions.new_empty(positions.shape[0], NUM_FEATURES * len(levels))
        use_threads()
        _forward(positions.numpy(), table.detach().contiguous().numpy(), *_layout(levels), features.numpy())
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P 2*L"]) -> tuple[None, Float[Tensor, "T 2"], None]:
        (positions,) = ctx.saved_tensors
        table = torch.zeros(ctx.num_entries, NUM_FEATURES)
        threads = min(use_threads(), len(ctx.levels))
        _backward(positions.numpy(), gradient.contiguous().numpy(), *_layout(ctx.levels), threads, table.numpy())
        return None, table, None


def _layout(levels: GridLevels) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return np.array(levels.resolutions), np.array(levels.sizes), np.array(levels.offsets), np.array(levels.dense)


@compiled
def _vertices(x, y, z, resolution, size, dense):
    """Offsets of the cell's eight vertices in its level, x fastest, and the position's fractions in the cell."""
    scale = np.float32(resolution)
    x = min(max(x, np.float32(0)), _ONE) * scale
    y = min(max(y, np.float32(0)), _ONE) * scale
    z = min(max(z, np.float32(0)), _ONE) * scale
    # Bounded below as well, because a position that is not a number becomes the smallest integer.
    i = max(min(np.int64(x), resolution - 1), 0)
    j = max(min(np.int64(y), resolution - 1), 0)
    k = max(min(np.int64(z), resolution - 1), 0)
    if dense:
        stride = resolution + 1
        a = i + stride * (j + stride * k)
        b, c = a + stride, a + stride * stride
        d = c + stride
        e, f, g, h = a + 1, b + 1, c + 1, d + 1
    else:
        # Sizes of hashed levels are powers of two, so that the remainder is a mask.
        mask, right = size - 1, i + 1
        y0, z0 = j * HASH_Y, k * HASH_Z
        y1, z1 = y0 + HASH_Y, z0 + HASH_Z
        a, b, c, d = (i ^ y0 ^ z0) & mask, (i ^ y1 ^ z0) & mask, (i ^ y0 ^ z1) & mask, (i ^ y1 ^ z1) & mask
        e, f, g, h = (
            (right ^ y0 ^ z0) & mask,
            (right ^ y1 ^ z0) & mask,
            (right ^ y0 ^ z1) & mask,
            (right ^ y1 ^ z1) & mask,
        )
    # Unsigned, because Numba counts signed ones from the end where they are negative, a test for each access.
    index = np.uintp
    vertices = (index(a), index(e), index(b), index(f), index(c), index(g), index(d), index(h))
    return vertices, x - np.float32(i), y - np.float32(j), z - np.float32(k)


@compiled_parallel
def _forward(positions, table, resolutions, sizes, offsets, dense, features):
    num_points = positions.shape[0]
    for block in prange((num_points + _BLOCK - 1) // _BLOCK):
        for level in range(resolutions.shape[0]):
            resolution, size, is_dense = resolutions[level], sizes[level], dense[level]
            entries = table[offsets[level] : offsets[level] + size]
            for p in range(block * _BLOCK, min(num_points, (block + 1) * _BLOCK)):
                v, x, y, z = _vertices(positions[p, 0], positions[p, 1], positions[p, 2], resolution, size, is_dense)
                w0, w1, w2, w3 = (_ONE - y) * (_ONE - z), y * (_ONE - z), (_ONE - y) * z, y * z
                for f in range(2):
                    left = w0 * entries[v[0], f] + w1 * entries[v[2], f]
                    left += w2 * entries[v[4], f] + w3 * entries[v[6], f]
                    right = w0 * entries[v[1], f] + w1 * entries[v[3], f]
                    right += w2 * entries[v[5], f] + w3 * entries[v[7], f]
                    features[p, 2 * level + f] = (_ONE - x) * left + x * right


@compiled_parallel
def _backward(positions, gradient, resolutions, sizes, offsets, dense, threads, table):
    num_points = positions.shape[0]
    # Levels are dealt out in turn, because fine ones cost more than coarse ones.
    for thread in prange(threads):
        for start in range(0, num_points, _BLOCK):
            for level in range(thread, resolutions.shape[0], threads):
                resolution, size, is_dense = resolutions[level], sizes[level], dense[level]
                entries = table[offsets[level] : offsets[level] + size]
                for p in range(start, min(num_points, start + _BLOCK)):
                    v, x, y, z = _vertices(
                        positions[p, 0], positions[p, 1], positions[p, 2], resolution, size, is_dense
                    )
                    w0, w1, w2, w3 = (_ONE - y) * (_ONE - z), y * (_ONE - z), (_ONE - y) * z, y * z
                    # Both are read before any entry is written, which might overlap for all the compiler knows.
                    both = (gradient[p, 2 * level], gradient[p, 2 * level + 1])
                    for f in range(2):
                        left, right = (_ONE - x) * both[f], x * both[f]
                        entries[v[0], f] += w0 * left
                        entries[v[1], f] += w0 * right
                        entries[v[2], f] += w1 * left
                        entries[v[3], f] += w1 * right
                        entries[v[4], f] += w2 * left
                        entries[v[5], f] += w2 * right
                        entries[v[6], f] += w3 * left
                        entries[v[7], f] += w3 * right
