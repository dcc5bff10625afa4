"""Loss on the depth of pixels, from a depth camera or from structure from motion."""

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
from nerfro.registry.allowed import Positive
from nerfro.registry.registration import register
from nerfro.rendering import Scene


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
