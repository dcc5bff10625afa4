"""Volume rendering with a boundary term."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.samplers.stepfun import volume_weights
from nerfro.types import Path, Radiance, Rendering, Samples


def composite(samples: Samples, radiance: Radiance, boundary_rgb: Float[Tensor, "P 3"], path: Path) -> Rendering:
    """Render one level: C = sum_i w_i c_i + T_{N+1} C'(d_N) (paper, Eqn. volrendBd), summed over a ray's polylines.

    In absorbing media, the radiance of samples and of the background is multiplied by the transmittance of the medium.
    """
    density, rgb = radiance.density.float(), radiance.rgb.float()  # sums over a ray stay in single precision
    weights, transmittance = volume_weights(density, samples.deltas)
    boundary_rgb = boundary_rgb.float()
    if path.absorbs:
        rgb = rgb * path.transmitted(samples.s)
        boundary_rgb = boundary_rgb * path.transmitted(path.far[:, None])[:, 0]
    colour = (weights[..., None] * rgb).sum(-2) + transmittance[:, None] * boundary_rgb
    return Rendering(path.per_ray(colour), weights, transmittance, boundary_rgb, samples, path)
