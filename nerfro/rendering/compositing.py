"""Volume rendering with a boundary term."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.samplers.points.stepfun import volume_weights
from nerfro.types import Path, Radiance, Rendering, Samples


def composite(samples: Samples, radiance: Radiance, boundary_rgb: Float[Tensor, "P 3"], path: Path) -> Rendering:
    """Composite one sampling level: C = sum_i w_i c_i + T_{N+1} C'(d_N) (paper, Eqn. 5).

    The radiance of a ray is the sum over its polylines. In absorbing media, the radiance of samples and of the
    background is multiplied by the transmittance of the medium.

    Args:
        samples: N samples on each of P polylines.
        radiance: density [P, N] per world unit, and radiance [P, N, 3] of the samples.
        boundary_rgb: background radiance in the exit direction of each polyline.
        path: the polylines of R rays.

    Returns:
        Radiance [R, 3] of the rays, with the weights and the transmittance of the polylines.
    """
    density, rgb = radiance.density.float(), radiance.rgb.float()  # sums over a ray stay in single precision
    weights, transmittance = volume_weights(density, samples.deltas)
    boundary_rgb = boundary_rgb.float()
    if path.absorbs:
        rgb = rgb * path.transmitted(samples.s)
        boundary_rgb = boundary_rgb * path.transmitted(path.far[:, None])[:, 0]
    colour = (weights[..., None] * rgb).sum(-2) + transmittance[:, None] * boundary_rgb
    return Rendering(path.sum_polylines(colour), weights, transmittance, boundary_rgb, samples, path)
