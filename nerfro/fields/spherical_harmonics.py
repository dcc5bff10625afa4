"""Real spherical harmonics as an encoding of directions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MAX_BANDS = 4


def spherical_harmonics(directions: Float[Tensor, "*batch 3"], num_bands: int) -> Float[Tensor, "*batch bases"]:
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
