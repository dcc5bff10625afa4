"""Real spherical harmonics as an encoding of directions.

`spherical_harmonics_in_torch` runs on GPUs, and is the reference implementation of the compiled kernels for CPUs.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor

from nerfro.kernels.compilation import compiled_parallel
from nerfro.kernels.operators import kernel_with_gradients, operator

MAX_BANDS = 4
# The reference's factors, by degree.
_C0, _C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
_C2, _C2_ZZ, _C2_XX_YY = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(0.5462742152960396)
_C3_OUTER, _C3_XYZ = np.float32(0.5900435899266435), np.float32(2.890611442640554)
_C3_MIDDLE, _C3_ZZZ = np.float32(0.4570457994644658), np.float32(0.3731763325901154)
_C3_XX_YY = np.float32(1.445305721320277)
_ONE, _TWO, _THREE, _FIVE, _SIX = np.float32(1), np.float32(2), np.float32(3), np.float32(5), np.float32(6)
_TEN, _FIFTEEN = np.float32(10), np.float32(15)


def spherical_harmonics_in_torch(
    directions: Float[Tensor, "*batch 3"], num_bands: int
) -> Float[Tensor, "*batch bases"]:
    """Evaluate the K = num_bands^2 orthonormal real harmonics of degrees l < num_bands, by degree and order."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    harmonics = [torch.full_like(x, 0.28209479177387814)]
    if num_bands > 1:
        harmonics += [c * v for c, v in zip((0.4886025119029199,) * 3, (y, z, x), strict=True)]
    if num_bands > 2:
        harmonics += [
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if num_bands > 3:
        harmonics += [
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(harmonics, dim=-1)


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
def _backward(directions, num_bands, gradient, of_directions):
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


_SCHEMA = "spherical_harmonics(Tensor directions, int num_bands)"
_of_rows = kernel_with_gradients(
    _SCHEMA,
    lambda directions, num_bands: directions.new_empty(directions.shape[0], num_bands**2),
    _harmonics,
    {0: _backward},
)
spherical_harmonics = operator(
    f"{_SCHEMA} -> Tensor",
    spherical_harmonics_in_torch,
    lambda directions, num_bands: _of_rows(directions.float().contiguous(), num_bands),
)
