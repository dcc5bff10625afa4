"""Losses on the density along paths."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch, Rendering
from nerfro.data.base import Views
from nerfro.data.depths import DEPTH
from nerfro.geometry.space import Space
from nerfro.losses.base import Loss
from nerfro.registry.allowed import Positive, Share
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "distortion")
class Distortion(Loss):
    """Penalize weights of the finest level that are spread along a path, as in fog (mip-NeRF 360, Eqn. 15).

    Arc length is measured in units of the length of the path, far - near, so that the loss does not depend on the scale
    of the scene. If space is contracted, contracted length is measured in units of its value at the last edge of the
    samples, where the final transmittance counts as a weight, because the loss would otherwise favour transparency.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        weights, edges = rendering.weights, rendering.samples.edges
        near, far = rendering.path.near[:, None], rendering.path.far[:, None]
        if (contracted_edges := rendering.samples.contracted_edges) is not None:
            near, far = torch.zeros_like(near), contracted_edges[:, -1:]
            weights = torch.cat([weights, rendering.transmittance[:, None]], -1)
            edges = torch.cat([contracted_edges, far], -1)
        # Paths of zero length have no weights; the clamp avoids a division by zero.
        edges = (edges - near) / (far - near).clamp(min=1e-6)
        return batch.per_pixel(rendering.path.sum_polylines(distortion(weights, edges))).mean()


def distortion(weights: Float[Tensor, "P N"], edges: Float[Tensor, "P N+1"]) -> Float[Tensor, "P"]:
    """Integrate w(u) w(v) |u - v| over u and v, for weights that are constant in their intervals.

    The integral is sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (e_{i+1} - e_i), with interval midpoints m (mip-NeRF
    360, Eqn. 15). Because midpoints ascend, the double sum is twice the sum over i of w_i (m_i W_i - M_i), where W_i
    and M_i are the sums of w_j and w_j m_j over j < i, and takes linear time.

    Args:
        weights: rendering weights of the intervals.
        edges: bounds of the intervals, ascending.
    """
    midpoints = 0.5 * (edges[:, 1:] + edges[:, :-1])
    # Only distances matter. Positions relative to the mean reduce cancellation between the two sums.
    midpoints = midpoints - midpoints.mean(-1, keepdim=True)
    moments = weights * midpoints
    weights_before = weights.cumsum(-1) - weights
    moments_before = moments.cumsum(-1) - moments
    between = 2 * (weights * (midpoints * weights_before - moments_before)).sum(-1)
    within = (weights.square() * (edges[:, 1:] - edges[:, :-1])).sum(-1) / 3
    return between + within


@register("loss", "near_camera")
class NearCamera(Loss):
    """Penalize density close to the cameras, with a weight that decreases with the distance.

    The weight of a sample at arc length s is max(1 - s / (r d), 0), where d is the distance of the camera from the
    centre of the space of the run and r the reach. Few rays cross the space close to a camera. Floating density in
    this space contradicts no photograph, but hides the scene from other directions. The loss is similar to the
    occlusion loss of FreeNeRF (Yang et al. 2023, Eqn. 8).

    Args:
        reach: fraction of the way from the camera to the centre where the penalty ends. A larger reach makes the front
            of the scene transparent.
    """

    weight = 1e-1
    needs_box = True

    def __init__(self, reach: Share = 0.5) -> None:
        super().__init__()
        self.reach = reach

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path = rendering.path
        cameras = (path.positions[:, 0] - path.near[:, None] * path.directions[:, 0]).detach()
        farthest = self.reach * (cameras - scene.space.centre).norm(dim=-1).clamp(min=1e-6)
        closeness = (1 - rendering.samples.s / farthest[:, None]).clamp(min=0)
        return batch.per_pixel(path.sum_polylines((rendering.weights * closeness).sum(-1))).mean()


@register("loss", "opaque")
class Opaque(Loss):
    """Penalize the squared final transmittance of each ray, for fields that cover all of space.

    Without this loss, a background of constant colour would replace objects of the same colour. The loss is the
    expected squared error that a background of random grey levels (variance 1) would cause.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        passed = renderings[-1].transmittance.square()
        return batch.per_pixel(renderings[-1].path.sum_polylines(passed)).mean()


@register("loss", "depth")
class Depth(Loss):
    """Penalize the relative distance between the point at which a ray ends and the depth of its pixel.

    A ray ends in the interval of sample i with the probability w_i, and in the background with the final transmittance
    T. The loss is the expected relative error sum_i w_i min(|m_i - D| / D, limit) + T limit at the finest level, where
    m_i is the middle of the interval and D is the arc length in `batch.maps["depth"]`. It is averaged over the pixels
    whose D is positive.

    Args:
        limit: largest relative error that counts, which bounds the influence of wrong depths.
        refracted: whether pixels count whose rays meet the medium. Depth cameras and structure from motion assume
            straight rays, so their depths are wrong there.
    """

    weight = 0.1

    def __init__(self, limit: Positive = 1.0, refracted: bool = False) -> None:
        super().__init__()
        self.limit, self.refracted = limit, refracted

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        """Refuse data without depths."""
        if DEPTH not in views.maps:
            raise NerfroError(
                "loss=depth needs depths, which the data lack; set data.depths=true (data=colmap) or data.depth_unit "
                "(data=nerfstudio with depth_file_path), or return Views(maps={'depth': ...}) in your data format"
            )
        return {}

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path, edges = rendering.path, rendering.samples.edges
        depth = batch.maps[DEPTH][:, 0]
        counts = depth > 0
        if not self.refracted:
            counts = counts & (batch.per_pixel(path.main_polyline(path.refracted).to(depth)) == 0)
        of_path = path.broadcast_to_polylines(torch.where(depth > 0, depth, 1.0)[batch.ray_pixel])[:, None]
        middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
        errors = ((middles - of_path).abs() / of_path).clamp(max=self.limit)
        expected = (rendering.weights * errors).sum(-1) + rendering.transmittance * self.limit
        per_pixel = batch.per_pixel(path.sum_polylines(expected))
        return (per_pixel * counts).sum() / counts.sum().clamp(min=1)
