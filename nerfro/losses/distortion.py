"""The distortion loss, on arc length."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering


@register("loss", "distortion")
class Distortion(Loss):
    """Spread of the last level's weights along each path, which fog has and surfaces have not (mip-NeRF 360, Eqn. 15).

    Arc length is measured in units of the path's length, far - near, so that the weight does not depend on the scene's
    scale; contracted length, where space is contracted, in units of all of it. There what passes all samples counts as
    well, at infinity: a loss of what is stopped alone would make things transparent.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        weights, edges = rendering.weights, rendering.samples.edges
        near, far = rendering.path.near[:, None], rendering.path.far[:, None]
        if (measure := rendering.samples.measure) is not None:
            near, far = torch.zeros_like(near), measure[:, -1:]
            weights, edges = torch.cat([weights, rendering.transmittance[:, None]], -1), torch.cat([measure, far], -1)
        # A path of no length has no weights either; the clamp only keeps the quotient a number.
        edges = (edges - near) / (far - near).clamp(min=1e-6)
        return batch.per_pixel(rendering.path.per_ray(distortion(weights, edges))).mean()


def distortion(weights: Float[Tensor, "R N"], edges: Float[Tensor, "R N+1"]) -> Float[Tensor, "R"]:
    """Integral of w(u) w(v) |u - v| over u and v, for weights spread evenly over their intervals.

    sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (e_{i+1} - e_i), with interval midpoints m (mip-NeRF 360, Eqn. 15). The
    double sum takes linear time: midpoints ascend, so it is twice the sum over i of w_i (m_i W_i - M_i), where W_i and
    M_i are the sums of w_j and w_j m_j over j < i.
    """
    midpoints = 0.5 * (edges[:, 1:] + edges[:, :-1])
    # Distances count, not places: from the middle of the path there is less cancellation between the two sums.
    midpoints = midpoints - midpoints.mean(-1, keepdim=True)
    moments = weights * midpoints
    weights_before = weights.cumsum(-1) - weights
    moments_before = moments.cumsum(-1) - moments
    between = 2 * (weights * (midpoints * weights_before - moments_before)).sum(-1)
    within = (weights.square() * (edges[:, 1:] - edges[:, :-1])).sum(-1) / 3
    return between + within
