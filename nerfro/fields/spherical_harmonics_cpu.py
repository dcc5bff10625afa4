"""Compiled CPU kernel of spherical harmonics; `nerfro.fields.spherical_harmonics` is its reference."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor

from nerfro.fields.spherical_harmonics import check_bands
from nerfro.kernels.compilation import compiled_parallel
from nerfro.kernels.threads import use_threads

# The reference's factors, by degree.
_C0, _C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
_C2, _C2_ZZ, _C2_XX_YY = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(0.5462742152960396)
_C3_OUTER, _C3_XYZ = np.float32(0.5900435899266435), np.float32(2.890611442640554)
_C3_MIDDLE, _C3_ZZZ = np.float32(0.4570457994644658), np.float32(0.3731763325901154)
_C3_XX_YY = np.float32(1.445305721320277)
_ONE, _THREE, _FIVE = np.float32(1), np.float32(3), np.float32(5)


def spherical_harmonics(directions: Float[Tensor, "P 3"], num_bands: int) -> Float[Tensor, "P K"]:
    """The same as `nerfro.fields.spherical_harmonics.spherical_harmonics`, on the CPU and without a gradient."""
    check_bands(num_bands)
    values = torch.empty(len(directions), num_bands**2)
    use_threads()
    _harmonics(directions.detach().float().contiguous().numpy(), num_bands, values.numpy())
    return values


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
