"""Conical frustums as Gaussians (mip-NeRF, section 3.1)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.types import Samples


def frustum_gaussians(samples: Samples) -> tuple[Float[Tensor, "R N 3"], Float[Tensor, "R N 3"]]:
    """Mean and diagonal covariance of the frustum that each sample's interval cuts out of its pixel's cone.

    mip-NeRF's Eqn. 7 and 16 in their numerically stable form. On a bent path the cone follows the local direction and
    widens with arc length, which neglects the focusing by the medium.
    """
    near, far = samples.edges[:, :-1], samples.edges[:, 1:]
    mu, half = 0.5 * (near + far), 0.5 * (far - near)
    denominator = 3 * mu**2 + half**2
    shift = 2 * mu * half**2 / denominator
    along = half**2 / 3 - (4 / 15) * half**4 * (12 * mu**2 - half**2) / denominator**2
    across = samples.radii[:, None] ** 2 * (mu**2 / 4 + (5 / 12) * half**2 - (4 / 15) * half**4 / denominator)
    mean = samples.positions + (mu + shift - samples.s)[..., None] * samples.directions
    squared = samples.directions**2
    variance = along[..., None] * squared + across[..., None] * (1 - squared)
    return mean, variance
