"""Compiled CPU kernels of the cube map lookup; `nerfro.backgrounds.cube_map.lookup` is the reference.

Threads divide the directions in the forward pass and the levels in the backward pass, where no two threads may write to
the same texel.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfro.backgrounds import cube_map
from nerfro.backgrounds.cube_map import CubeLevels
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.kernels.operators import kernel, operator
from nerfro.kernels.threads import num_threads

_ONE = np.float32(1)


def lookup(
    face: Int[Tensor, "P"],
    coordinates: Float[Tensor, "P 2"],
    texels: Float[Tensor, "T 3"],
    padded: Int[Tensor, " padded"],
    levels: CubeLevels,
) -> Float[Tensor, "P 3"]:
    """Evaluate `nerfro.backgrounds.cube_map.lookup`, on the CPU by the kernels."""
    return _lookup(face, coordinates, texels, padded, levels.resolutions)


def _in_torch(face: Tensor, coordinates: Tensor, texels: Tensor, padded: Tensor, resolutions: list[int]) -> Tensor:
    return cube_map.lookup(face, coordinates, texels, padded, CubeLevels(tuple(resolutions)))


_lookup = operator(
    "cube_lookup(Tensor face, Tensor coordinates, Tensor texels, Tensor padded, int[] resolutions) -> Tensor",
    _in_torch,
    lambda face, coordinates, *others: _Lookup.apply(face, coordinates.contiguous(), *others),
)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, face: Tensor, coordinates: Tensor, texels: Tensor, padded: Tensor, resolutions: list[int]
    ) -> Tensor:
        ctx.save_for_backward(face, coordinates, padded, texels)
        ctx.resolutions = resolutions
        return _sum_of_levels(face, coordinates, padded, texels, resolutions)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P 3"]) -> tuple:
        of_coordinates = of_texels = None
        if ctx.needs_input_grad[1]:
            of_coordinates = _gradient_of_coordinates(*ctx.saved_tensors, gradient, ctx.resolutions)
        if ctx.needs_input_grad[2]:
            of_texels = _gradient_of_texels(*ctx.saved_tensors, gradient, ctx.resolutions)
        return None, of_coordinates, of_texels, None, None


_ARGUMENTS = "Tensor face, Tensor coordinates, Tensor padded, Tensor texels"


@kernel(
    f"cube_lookup_forward({_ARGUMENTS}, int[] resolutions) -> Tensor",
    lambda face, coordinates, padded, texels, resolutions: texels.new_empty(len(face), 3),
)
def _sum_of_levels(
    face: np.ndarray, coordinates: np.ndarray, padded: np.ndarray, texels: np.ndarray, resolutions: list[int]
) -> Float[np.ndarray, "P 3"]:
    total = np.zeros((len(face), 3), texels.dtype)
    _forward(face, coordinates, padded, *_layout(tuple(resolutions)), texels, total)
    return total


@kernel(
    f"cube_lookup_coordinates({_ARGUMENTS}, Tensor gradient, int[] resolutions) -> Tensor",
    lambda face, coordinates, padded, texels, gradient, resolutions: torch.empty_like(coordinates),
)
def _gradient_of_coordinates(
    face: np.ndarray, coordinates: np.ndarray, padded: np.ndarray, texels: np.ndarray,
    gradient: np.ndarray, resolutions: list[int],
) -> Float[np.ndarray, "P 2"]:  # fmt: skip
    of_coordinates, layout = np.empty_like(coordinates), _layout(tuple(resolutions))
    _backward_to_coordinates(face, coordinates, padded, *layout, texels, gradient, of_coordinates)
    return of_coordinates


@kernel(
    f"cube_lookup_texels({_ARGUMENTS}, Tensor gradient, int[] resolutions) -> Tensor",
    lambda face, coordinates, padded, texels, gradient, resolutions: torch.empty_like(texels),
)
def _gradient_of_texels(
    face: np.ndarray, coordinates: np.ndarray, padded: np.ndarray, texels: np.ndarray,
    gradient: np.ndarray, resolutions: list[int],
) -> Float[np.ndarray, "T 3"]:  # fmt: skip
    of_texels, layout = np.zeros_like(texels), _layout(tuple(resolutions))
    _backward(min(num_threads(), len(resolutions)), face, coordinates, padded, *layout, gradient, of_texels)
    return of_texels


@lru_cache(maxsize=64)
def _layout(resolutions: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(resolutions), np.array(CubeLevels(resolutions).offsets)


@compiled
def _taps(face, x, y, n, padded, padded_offset):
    """Return four texels of a level, the position between them, and the missing one at a cube corner (or -1)."""
    x = (x + _ONE) * np.float32(0.5 * n) + np.float32(0.5)
    y = (y + _ONE) * np.float32(0.5 * n) + np.float32(0.5)
    column, row = max(min(np.int64(x), n), 0), max(min(np.int64(y), n), 0)
    u, v = x - np.float32(column), y - np.float32(row)
    if 0 < column < n and 0 < row < n:  # between texels of one face
        inside = (face * n + row - 1) * n + column - 1
        return (inside, inside + 1, inside + n, inside + n + 1), u, v, -1
    at_corner = (column == 0 or column == n) and (row == 0 or row == n)
    missing = (1 if column == n else 0) + (2 if row == n else 0) if at_corner else -1
    width = n + 2
    first = padded_offset + (face * width + row) * width + column
    texels = (padded[first], padded[first + 1], padded[first + width], padded[first + width + 1])
    return texels, u, v, missing


@compiled
def _weights(u, v, missing):
    """Return the weights of the four texels; the missing one is the mean of the other three."""
    w0, w1, w2, w3 = (_ONE - u) * (_ONE - v), u * (_ONE - v), (_ONE - u) * v, u * v
    if missing >= 0:
        absent = (w0 if missing == 0 else w1 if missing == 1 else w2 if missing == 2 else w3) / np.float32(3)
        w0 = np.float32(0) if missing == 0 else w0 + absent
        w1 = np.float32(0) if missing == 1 else w1 + absent
        w2 = np.float32(0) if missing == 2 else w2 + absent
        w3 = np.float32(0) if missing == 3 else w3 + absent
    return w0, w1, w2, w3


@compiled_parallel
def _forward(face, coordinates, padded, resolutions, offsets, texels, total):
    for p in prange(face.shape[0]):
        padded_offset = 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            (a, b, c, d), u, v, missing = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
            w0, w1, w2, w3 = _weights(u, v, missing)
            of_level = texels[offsets[level] :]
            for channel in range(3):
                total[p, channel] += (
                    w0 * of_level[a, channel] + w1 * of_level[b, channel]
                    + w2 * of_level[c, channel] + w3 * of_level[d, channel]
                )  # fmt: skip
            padded_offset += 6 * (n + 2) * (n + 2)


@compiled_parallel
def _backward(threads, face, coordinates, padded, resolutions, offsets, gradient, texels):
    for thread in prange(threads):
        padded_offset = 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            if level % threads == thread:
                for p in range(face.shape[0]):
                    x, y = coordinates[p, 0], coordinates[p, 1]
                    texel, u, v, missing = _taps(face[p], x, y, n, padded, padded_offset)
                    weight = _weights(u, v, missing)
                    for corner in range(4):
                        entry = offsets[level] + texel[corner]
                        for channel in range(3):
                            texels[entry, channel] += weight[corner] * gradient[p, channel]
            padded_offset += 6 * (n + 2) * (n + 2)


@compiled_parallel
def _backward_to_coordinates(face, coordinates, padded, resolutions, offsets, texels, gradient, of_coordinates):
    for p in prange(face.shape[0]):
        padded_offset = 0
        along_x, along_y = np.float32(0), np.float32(0)
        # Derivative of the loss with respect to the weight of each of the four texels.
        gain = np.empty(4, np.float32)
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            texel, u, v, missing = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
            for corner in range(4):
                entry = offsets[level] + texel[corner]
                gain[corner] = np.float32(0)
                for channel in range(3):
                    gain[corner] += gradient[p, channel] * texels[entry, channel]
            if missing >= 0:
                gain[missing] = (gain[0] + gain[1] + gain[2] + gain[3] - gain[missing]) / np.float32(3)
            scale = np.float32(0.5 * n)
            along_x += scale * ((_ONE - v) * (gain[1] - gain[0]) + v * (gain[3] - gain[2]))
            along_y += scale * ((_ONE - u) * (gain[2] - gain[0]) + u * (gain[3] - gain[1]))
            padded_offset += 6 * (n + 2) * (n + 2)
        of_coordinates[p, 0], of_coordinates[p, 1] = along_x, along_y
