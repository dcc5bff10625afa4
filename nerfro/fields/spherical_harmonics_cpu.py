"""Compiled CPU kernels of spherical harmonics; the reference is `nerfro.fields.spherical_harmonics`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nerfro.fields import spherical_harmonics as reference
from nerfro.kernels.compilation import compiled_parallel
from nerfro.kernels.operators import kernel, operator

# The reference's factors, by degree.
_C0, _C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
_C2, _C2_ZZ, _C2_XX_YY = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(0.5462742152960396)
_C3_OUTER, _C3_XYZ = np.float32(0.5900435899266435), np.float32(2.890611442640554)
_C3_MIDDLE, _C3_ZZZ = np.float32(0.4570457994644658), np.float32(0.3731763325901154)
_C3_XX_YY = np.float32(1.445305721320277)
_ONE, _TWO, _THREE, _FIVE, _SIX = np.float32(1), np.float32(2), np.float32(3), np.float32(5), np.float32(6)
_TEN, _FIFTEEN = np.float32(10), np.float32(15)


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, num_bands: int) -> Tensor:
        ctx.save_for_backward(directions)
        ctx.num_bands = num_bands
        return _evaluate(directions, num_bands)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "directions bases"]) -> tuple[Float[Tensor, "directions 3"], None]:
        return _gradient(*ctx.saved_tensors, gradient, ctx.num_bands), None


spherical_harmonics = operator(
    "spherical_harmonics(Tensor directions, int num_bands) -> Tensor",
    reference.spherical_harmonics,
    lambda directions, num_bands: _Harmonics.apply(directions.float().contiguous(), num_bands),
)


@kernel(
    "spherical_harmonics_forward(Tensor directions, int num_bands) -> Tensor",
    lambda directions, num_bands: directions.new_empty(len(directions), num_bands**2),
)
def _evaluate(directions: Float[np.ndarray, "directions 3"], num_bands: int) -> Float[np.ndarray, "directions bases"]:
    values = np.empty((len(directions), num_bands**2), directions.dtype)
    _harmonics(directions, num_bands, values)
    return values


@kernel(
    "spherical_harmonics_backward(Tensor directions, Tensor gradient, int num_bands) -> Tensor",
    lambda directions, gradient, num_bands: torch.empty_like(directions),
)
def _gradient(
    directions: Float[np.ndarray, "directions 3"], gradient: Float[np.ndarray, "directions bases"], num_bands: int
) -> Float[np.ndarray, "directions 3"]:
    of_directions = np.zeros_like(directions)
    _backward(directions, gradient, num_bands, of_directions)
    return of_directions


@compiled_parallel
def _harmonics(directions, num_bands, values):
    for p in prange(directions.shape[0]):
        x, y, z = directions[p, 0], directions[p, 1], directions[p, 2]
        xx, yy, zz = x * x, y * y, z * z
        values[p, 0] = _C0
        if num_bands > 1:
            values[p, 1], values[p, 2], values[p, 3] = _C1 * y, _C1 * z, _C1 * x
        if num_bands > 2:
            values[p, 4], values[p, 5] = _C2 * x * y, _C2 * y * z
            values[p, 6] = _C2_ZZ * (_THREE * zz - _ONE)
            values[p, 7], values[p, 8] = _C2 * x * z, _C2_XX_YY * (xx - yy)
        if num_bands > 3:
            values[p, 9], values[p, 10] = _C3_OUTER * y * (_THREE * xx - yy), _C3_XYZ * x * y * z
            values[p, 11] = _C3_MIDDLE * y * (_FIVE * zz - _ONE)
            values[p, 12] = _C3_ZZZ * z * (_FIVE * zz - _THREE)
            values[p, 13] = _C3_MIDDLE * x * (_FIVE * zz - _ONE)
            values[p, 14], values[p, 15] = _C3_XX_YY * z * (xx - yy), _C3_OUTER * x * (xx - _THREE * yy)


@compiled_parallel
def _backward(directions, gradient, num_bands, of_directions):
    """Add the derivatives of the polynomials in `_harmonics`, multiplied by the upstream gradients."""
    for p in prange(directions.shape[0]):
        x, y, z, g = directions[p, 0], directions[p, 1], directions[p, 2], gradient[p]
        xx, yy, zz = x * x, y * y, z * z
        dx, dy, dz = np.float32(0), np.float32(0), np.float32(0)
        if num_bands > 1:
            dx, dy, dz = _C1 * g[3], _C1 * g[1], _C1 * g[2]
        if num_bands > 2:
            dx += _C2 * (y * g[4] + z * g[7]) + _TWO * _C2_XX_YY * x * g[8]
            dy += _C2 * (x * g[4] + z * g[5]) - _TWO * _C2_XX_YY * y * g[8]
            dz += _C2 * (y * g[5] + x * g[7]) + _SIX * _C2_ZZ * z * g[6]
        if num_bands > 3:
            dx += _C3_OUTER * (_SIX * x * y * g[9] + _THREE * (xx - yy) * g[15]) + _C3_XYZ * y * z * g[10]
            dx += _C3_MIDDLE * (_FIVE * zz - _ONE) * g[13] + _TWO * _C3_XX_YY * x * z * g[14]
            dy += _C3_OUTER * (_THREE * (xx - yy) * g[9] - _SIX * x * y * g[15]) + _C3_XYZ * x * z * g[10]
            dy += _C3_MIDDLE * (_FIVE * zz - _ONE) * g[11] - _TWO * _C3_XX_YY * y * z * g[14]
            dz += _C3_XYZ * x * y * g[10] + _TEN * _C3_MIDDLE * z * (y * g[11] + x * g[13])
            dz += _C3_ZZZ * (_FIFTEEN * zz - _THREE) * g[12] + _C3_XX_YY * (xx - yy) * g[14]
        of_directions[p, 0], of_directions[p, 1], of_directions[p, 2] = dx, dy, dz
