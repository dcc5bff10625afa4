"""Volume rendering: weights of the samples of a path (paper, Eqn. 1), and radiance of a ray (Eqn. 5)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import FieldValues, Path, Rendering, Samples


def volume_weights(
    density: Float[Tensor, "P N"], deltas: Float[Tensor, "P N"]
) -> tuple[Float[Tensor, "P N"], Float[Tensor, "P"]]:
    """Compute the weights w_i = T_i (1 - exp(-sigma_i delta_i)) and the transmittance T_{N+1} (paper, Eqn. 1).

    Args:
        density: density per world unit.
        deltas: interval lengths in world units.

    Returns:
        Weights and transmittance, which sum to one on every ray.
    """
    optical_depth = density * deltas
    total = optical_depth.cumsum(-1)
    transmittance = torch.exp(-torch.cat([torch.zeros_like(total[:, :1]), total], dim=-1))
    weights = -torch.expm1(-optical_depth) * transmittance[:, :-1]
    return weights, transmittance[:, -1]


def composite(
    samples: Samples, field_values: FieldValues, background_radiance: Float[Tensor, "P 3"], path: Path
) -> Rendering:
    """Composite one sampling level: C = sum_i w_i c_i + T_{N+1} C'(d_N) (paper, Eqn. 5).

    The radiance of a ray is the sum over its polylines. In absorbing media, the radiance of samples and of the
    background is multiplied by the transmittance of the medium.

    Args:
        samples: N samples on each of P polylines.
        field_values: density [P, N] per world unit, and radiance [P, N, 3] of the samples.
        background_radiance: background radiance in the exit direction of each polyline.
        path: the polylines of R rays.

    Returns:
        Radiance [R, 3] of the rays, with the weights and the transmittance of the polylines.
    """
    # Sums over a ray stay in single precision.
    density, radiance = field_values.density.float(), field_values.radiance.float()
    weights, transmittance = volume_weights(density, samples.deltas)
    background_radiance = background_radiance.float()
    if path.absorbs:
        radiance = radiance * path.transmitted(samples.s)
        background_radiance = background_radiance * path.whole_transmittance()
    radiance = (weights[..., None] * radiance).sum(-2) + transmittance[:, None] * background_radiance
    return Rendering(path.sum_polylines(radiance), weights, transmittance, background_radiance, samples, path)
