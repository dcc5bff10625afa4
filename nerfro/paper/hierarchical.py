"""Hierarchical sampling on arc length (paper, section 2): fine samples where the coarse rendering has weight."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le, Lt
from jaxtyping import Float
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.types import Path, Rendering, Samples
from nerfro.geometry.space import Space
from nerfro.registry.registration import register
from nerfro.samplers.base import PointSampler
from nerfro.samplers.points.stratified import (
    LAST_DELTA,
    Stratified,
    cone_samples,
    invert_cdf,
    midpoints,
    point_samples,
    spread_uniform,
)

# Weight that mip-NeRF adds to each bin before sampling.
_PADDING = 0.01


@register("sampler/points", "hierarchical")
class Hierarchical(PointSampler):
    """Draw coarse stratified samples, and fine samples by inverse transform sampling of the coarse weights.

    Fine arc lengths are mapped to the path by the nearest previous vertex, so that fine samples lie on the bent ray
    (paper, Fig. 3). Points are rendered together with the coarse points (NeRF, the paper). Cones replace the coarse
    cones, and are drawn from weights with max-blur and padding (mip-NeRF).

    Args:
        num_coarse: number of coarse samples, N_c.
        num_fine: number of fine samples, N_f.
        draw, cast, offset, space: options of the coarse samples, see `stratified`.
    """

    num_levels = 2

    def __init__(
        self,
        num_coarse: Annotated[int, Ge(4), Le(8192)] = 64,
        num_fine: Annotated[int, Ge(1), Le(8192)] = 128,
        draw: Literal["arc_length", "vertices"] = "arc_length",
        cast: Literal["points", "cones"] = "points",
        offset: Annotated[float, Ge(0), Lt(1)] = 0.5,
        space: Space | None = None,
    ) -> None:
        super().__init__()
        self.coarse = Stratified(num_coarse, draw, cast, offset, space)
        self.num_fine, self.cast = num_fine, cast

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        if previous is None:
            return self.coarse(path, None, draws)
        if self.cast == "cones":
            u = spread_uniform(path, self.num_fine + 1, draws, "fine samples")
            return cone_samples(path, _draw(previous.samples.edges, blur_weights(previous.weights, _PADDING), u))
        # Weights belong to samples, so the bins of the distribution lie between the midpoints of samples.
        u = spread_uniform(path, self.num_fine, draws, "fine samples")
        s = _draw(midpoints(previous.samples.s), previous.weights[:, 1:-1], u)
        last = LAST_DELTA if self.coarse.draw == "vertices" else None
        return point_samples(path, torch.cat([previous.samples.s, s], dim=1).sort(dim=1).values, last)


@torch.no_grad()
def _draw(
    edges: Float[Tensor, "P E"], weights: Float[Tensor, "P E-1"], u: Float[Tensor, "P N"]
) -> Float[Tensor, "P N"]:
    return invert_cdf(edges, weights.to(edges.dtype), u)


def blur_weights(weights: Float[Tensor, "P N"], padding: float) -> Float[Tensor, "P N"]:
    """Apply the max-then-average filter of mip-NeRF (Eqn. 18) and add a constant, so that fewer surfaces are missed."""
    padded = torch.cat([weights[..., :1], weights, weights[..., -1:]], dim=-1)
    highest = torch.maximum(padded[..., :-1], padded[..., 1:])
    return 0.5 * (highest[..., :-1] + highest[..., 1:]) + padding
