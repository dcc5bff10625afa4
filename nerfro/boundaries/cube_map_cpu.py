"""Compiled CPU kernels of the cube map's lookup; `nerfro.boundaries.cube_map.lookup` is their reference.

Forward, threads share the directions; backward, the levels, so that no two threads write to the same texel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfro.boundaries.cube_map import CubeLevels
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.threads import use_threads

_ONE = np.float32(1)


def lookup(
    face: Int[Tensor, "P"],
    coordinates: Float[Tensor, "P 2"],
    texels: Float[Tensor, "T 3"],
    padded: Int[Tensor, "Q"],
    levels: CubeLevels,
) -> Float[Tensor, "P 3"]:
    """The same as `nerfro.boundaries.cube_map.lookup`, on the CPU."""
    return _Lookup.apply(face.contiguous(), coordinates.contiguous(), texels, padded, levels)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        face: Int[Tensor, "P"],
        coordinates: Float[Tensor, "P 2"],
        texels: Float[Tensor, "T 3"],
        padded: Int[Tensor, "Q"],
        levels: CubeLevels,
    ) -> Float[Tensor, "P 3"]:
        ctx.save_for_backward(face, coordinates, padded)
        ctx.levels = levels
        total = torch.zeros(len(face), 3)
        use_threads()
        _forward(
            face.numpy(), coordinates.numpy(), padded.numpy(), *_layout(levels), texels.detach().numpy(), total.numpy()
        )
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P 3"]) -> tuple:
        face, coordinates, padded = ctx.saved_tensors
        texels = torch.zeros(ctx.levels.num_texels, 3)
        threads = min(use_threads(), len(ctx.levels))
        _backward(
            face.numpy(),
            coordinates.numpy(),
            padded.numpy(),
            *_layout(ctx.levels),
            threads,
            gradient.contiguous().numpy(),
            texels.numpy(),
        )
        return None, None, texels, None, None


def _layout(levels: CubeLevels) -> tuple[np.ndarray, np.ndarray]:
    return np.array(levels.resolutions), np.array(levels.offsets)


@compiled
def _taps(face, x, y, n, padded, padded_offset):
    """Four texels of a level and their weights; where three faces meet, the missing texel is the mean of the three."""
    x = (x + _ONE) * np.float32(0.5 * n) + np.float32(0.5)
    y = (y + _ONE) * np.float32(0.5 * n) + np.float32(0.5)
    column, row = max(min(np.int64(x), n), 0), max(min(np.int64(y), n), 0)
    u, v = x - np.float32(column), y - np.float32(row)
    w0, w1, w2, w3 = (_ONE - u) * (_ONE - v), u * (_ONE - v), (_ONE - u) * v, u * v
    if (column == 0 or column == n) and (row == 0 or row == n):
        missing = (1 if column == n else 0) + (2 if row == n else 0)
        absent = (w0 if missing == 0 else w1 if missing == 1 else w2 if missing == 2 else w3) / np.float32(3)
        w0 = np.float32(0) if missing == 0 else w0 + absent
        w1 = np.float32(0) if missing == 1 else w1 + absent
        w2 = np.float32(0) if missing == 2 else w2 + absent
        w3 = np.float32(0) if missing == 3 else w3 + absent
    width = n + 2
    first = padded_offset + (face * width + row) * width + column
    texels = (padded[first], padded[first + 1], padded[first + width], padded[first + width + 1])
    return texels, (w0, w1, w2, w3)


@compiled_parallel
def _forward(face, coordinates, padded, resolutions, offsets, texels, total):
    for p in prange(face.shape[0]):
        padded_offset = 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            texel, weight = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
            for corner in range(4):
                entry = offsets[level] + texel[corner]
                for channel in range(3):
                    total[p, channel] += weight[corner] * texels[entry, channel]
            padded_offset += 6 * (n + 2) * (n + 2)


@compiled_parallel
def _backward(face, coordinates, padded, resolutions, offsets, threads, gradient, texels):
    for thread in prange(threads):
        padded_offset = 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            if level % threads == thread:
                for p in range(face.shape[0]):
                    texel, weight = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
                    for corner in range(4):
                        entry = offsets[level] + texel[corner]
                        for channel in range(3):
                            texels[entry, channel] += weight[corner] * gradient[p, channel]
            padded_offset += 6 * (n + 2) * (n + 2)
