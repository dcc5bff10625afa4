"""Volume rendering with a background term."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import FieldValues, Path, Rendering, Samples
from nerfro.samplers.points.stepfun import volume_weights


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
        background_radiance = background_radiance * path.transmitted(path.far[:, None])[:, 0]
    radiance = (weights[..., None] * radiance).sum(-2) + transmittance[:, None] * background_radiance
    return Rendering(path.sum_polylines(radiance), weights, transmittance, background_radiance, samples, path)
