"""An equi-angular cube map with several resolutions.

Face 2 a + b is the side of the cube at the positive (b = 0) or negative (b = 1) end of axis a. The first texture
coordinate of a face is the angle towards axis a + 1 (modulo 3), and the second the angle towards axis a + 2. All texels
have the same width in angle, which keeps their solid angles within a factor of 1.4.

`lookup_in_torch` runs on GPUs, and is the reference implementation of the compiled kernels for CPUs. Threads divide the
directions in the forward pass and the levels in the backward pass, where no two threads may write to the same texel.
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

from nerfro.kernels.compilation import compiled, compiled_parallel, num_threads
from nerfro.kernels.constants import constant
from nerfro.kernels.operators import kernel_with_gradients, operator

_ONE = np.float32(1)


@dataclass(frozen=True)
class CubeLevels:
    """Layout of the texels of all levels in one list; each level is ordered by face, row and column."""

    resolutions: tuple[int, ...]  # texels along a face's side

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(6 * n * n for n in self.resolutions)

    @property
    def padded_sizes(self) -> tuple[int, ...]:
        """Number of texels of each level with margins, see `padded_texels`."""
        return tuple(6 * (n + 2) ** 2 for n in self.resolutions)

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(sum(self.sizes[:level]) for level in range(len(self.resolutions)))

    @property
    def num_texels(self) -> int:
        return sum(self.sizes)

    @property
    def num_padded(self) -> int:
        return sum(self.padded_sizes)


def project(directions: Float[Tensor, "P 3"]) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 2"]]:
    """Return the face that a direction hits and the texture coordinates in [-1, 1], which are linear in angle."""
    axis = directions.abs().argmax(-1)
    order = constant(((0, 1, 2), (1, 2, 0), (2, 0, 1)), directions.device).index_select(0, axis)
    main, across = directions.gather(-1, order).split((1, 2), -1)
    return 2 * axis + (main[:, 0] < 0), torch.atan(across / main.abs()) * (4 / math.pi)


def unproject(face: Int[Tensor, "P"], coordinates: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Return the unit direction at texture coordinates of a face; the inverse of `project`.

    Coordinates may exceed [-1, 1] by up to 1; such points lie on the extended plane of the face.
    """
    axis = torch.div(face, 2, rounding_mode="floor")
    sign = 1.0 - 2.0 * (face % 2)
    across = torch.tan(coordinates * (math.pi / 4))
    components = torch.cat([sign.to(across)[:, None], across], dim=-1)
    # Component k of the result is number k - axis of (main, first, second).
    order = (torch.arange(3, device=face.device) - axis[:, None]) % 3
    return torch.nn.functional.normalize(components.gather(-1, order), dim=-1)


def texel_directions(resolution: int) -> Float[Tensor, "T 3"]:
    """Return the unit directions of the texel centres of one level."""
    centres = (torch.arange(resolution) + 0.5) / resolution * 2 - 1
    face = torch.arange(6).repeat_interleave(resolution**2)
    row, column = (values.flatten().repeat(6) for values in torch.meshgrid(centres, centres, indexing="ij"))
    return unproject(face, torch.stack([column, row], dim=-1))


def padded_texels(resolution: int) -> Int[Tensor, "6 m m"]:
    """Return the texel at each place of the faces, with a margin of one texel from the neighbouring faces.

    Three faces meet at a corner, where no fourth texel exists. The corners of the margin are therefore not valid.
    """
    n, margin = resolution, torch.ones(resolution + 2, resolution + 2, dtype=torch.bool)
    margin[1:-1, 1:-1] = False
    # In double precision, because texels beside a corner project almost to the border of the neighbouring face.
    texels_of_margin = margin.nonzero().flip(-1)
    coordinates = (texels_of_margin - 0.5).double() / n * 2 - 1
    directions = unproject(torch.arange(6).repeat_interleave(len(coordinates)), coordinates.repeat(6, 1))
    texels = torch.empty(6, n + 2, n + 2, dtype=torch.int32)
    texels[:, 1:-1, 1:-1] = torch.arange(6 * n * n).view(6, n, n)
    texels[:, margin] = nearest_texel(directions, n).view(6, -1).int()
    return texels


def nearest_texel(directions: Float[Tensor, "P 3"], resolution: int) -> Int[Tensor, "P"]:
    """Return the texel of one level that each direction hits."""
    (face, coordinates), n = project(directions), resolution
    column, row = ((coordinates + 1) / 2 * n).long().clamp(0, n - 1).unbind(-1)
    return (face * n + row) * n + column


def lookup_in_torch(
    face: Int[Tensor, "P"],
    coordinates: Float[Tensor, "P 2"],
    texels: Float[Tensor, "T 3"],
    padded: Int[Tensor, " padded"],
    resolutions: Sequence[int],
) -> Float[Tensor, "P 3"]:
    """Sum the bilinear interpolations of all levels, which are continuous over the sphere.

    The result is differentiable with respect to the texels and, between texel centres, to the coordinates.

    Args:
        face, coordinates: see `project`.
        texels: of all levels.
        padded: `padded_texels` of all levels, flattened, one level after the other.
        resolutions: of all levels, see `CubeLevels`.
    """
    levels = CubeLevels(tuple(resolutions))
    padded_offsets = tuple(sum(levels.padded_sizes[:level]) for level in range(len(resolutions)))
    widths, ends = tuple(n + 2 for n in resolutions), tuple(((0, n),) for n in resolutions)
    width, end, offset, padded_offset = (
        constant(values, texels.device) for values in (widths, ends, levels.offsets, padded_offsets)
    )
    half = constant(tuple((0.5 * n,) for n in resolutions), texels.device, coordinates.dtype)
    # Axes are points, levels, and (column, row) or the four texels around a point, of which the first two share a row.
    position = (coordinates[:, None] + 1) * half + 0.5  # in padded texels, with integer centres
    corner = torch.minimum(position.long().clamp(min=0), end[..., 1])
    fraction, (column, row) = position - corner, corner.unbind(-1)
    sides = torch.stack([1 - fraction, fraction], dim=-1)
    weights = (sides[:, :, 1, :, None] * sides[:, :, 0, None]).flatten(-2)
    # Where three faces meet, the missing fourth texel is the mean of the three.
    at_end = corner[..., None] == end
    missing = (at_end[:, :, 1, :, None] & at_end[:, :, 0, None]).flatten(-2)
    absent = (weights * missing).sum(-1, keepdim=True)
    weights = torch.where(missing, 0.0, weights + absent / 3)
    first = padded_offset + (face[:, None] * width + row) * width + column
    index = first[..., None] + constant(tuple((0, 1, n + 2, n + 3) for n in levels.resolutions), texels.device)
    texel = padded.index_select(0, index.flatten()).view(index.shape) + offset[:, None]
    # The gradient of index_select is one index_add; that of indexing with brackets sorts all indices first.
    return (texels.index_select(0, texel.flatten()).view(*texel.shape, 3) * weights[..., None]).sum((1, 2))


def _gradient_of_texels(
    face: np.ndarray, coordinates: np.ndarray, texels: np.ndarray, padded: np.ndarray, resolutions: np.ndarray,
    gradient: np.ndarray, of_texels: Float[np.ndarray, "T 3"],
) -> None:  # fmt: skip
    threads = min(num_threads(), len(resolutions))
    _backward(threads, face, coordinates, padded, resolutions, gradient, of_texels)


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
def _forward(face, coordinates, texels, padded, resolutions, total):
    for p in prange(face.shape[0]):
        offset, padded_offset = 0, 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            (a, b, c, d), u, v, missing = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
            w0, w1, w2, w3 = _weights(u, v, missing)
            of_level = texels[offset:]
            for channel in range(3):
                total[p, channel] += (
                    w0 * of_level[a, channel] + w1 * of_level[b, channel]
                    + w2 * of_level[c, channel] + w3 * of_level[d, channel]
                )  # fmt: skip
            offset, padded_offset = offset + 6 * n * n, padded_offset + 6 * (n + 2) * (n + 2)


@compiled_parallel
def _backward(threads, face, coordinates, padded, resolutions, gradient, texels):
    for thread in prange(threads):
        offset, padded_offset = 0, 0
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            if level % threads == thread:
                for p in range(face.shape[0]):
                    x, y = coordinates[p, 0], coordinates[p, 1]
                    texel, u, v, missing = _taps(face[p], x, y, n, padded, padded_offset)
                    weight = _weights(u, v, missing)
                    for corner in range(4):
                        entry = offset + texel[corner]
                        for channel in range(3):
                            texels[entry, channel] += weight[corner] * gradient[p, channel]
            offset, padded_offset = offset + 6 * n * n, padded_offset + 6 * (n + 2) * (n + 2)


@compiled_parallel
def _backward_to_coordinates(face, coordinates, texels, padded, resolutions, gradient, of_coordinates):
    for p in prange(face.shape[0]):
        offset, padded_offset = 0, 0
        along_x, along_y = np.float32(0), np.float32(0)
        # Derivative of the loss with respect to the weight of each of the four texels.
        gain = np.empty(4, np.float32)
        for level in range(resolutions.shape[0]):
            n = resolutions[level]
            texel, u, v, missing = _taps(face[p], coordinates[p, 0], coordinates[p, 1], n, padded, padded_offset)
            for corner in range(4):
                entry = offset + texel[corner]
                gain[corner] = np.float32(0)
                for channel in range(3):
                    gain[corner] += gradient[p, channel] * texels[entry, channel]
            if missing >= 0:
                gain[missing] = (gain[0] + gain[1] + gain[2] + gain[3] - gain[missing]) / np.float32(3)
            scale = np.float32(0.5 * n)
            along_x += scale * ((_ONE - v) * (gain[1] - gain[0]) + v * (gain[3] - gain[2]))
            along_y += scale * ((_ONE - u) * (gain[2] - gain[0]) + u * (gain[3] - gain[1]))
            offset, padded_offset = offset + 6 * n * n, padded_offset + 6 * (n + 2) * (n + 2)
        of_coordinates[p, 0], of_coordinates[p, 1] = along_x, along_y


_SCHEMA = "cube_lookup(Tensor face, Tensor coordinates, Tensor texels, Tensor padded, int[] resolutions)"
_on_cpu = kernel_with_gradients(
    _SCHEMA,
    lambda face, coordinates, texels, padded, resolutions: texels.new_zeros(face.shape[0], 3),
    _forward,
    {1: _backward_to_coordinates, 2: _gradient_of_texels},
)
lookup = operator(f"{_SCHEMA} -> Tensor", lookup_in_torch, _on_cpu)
