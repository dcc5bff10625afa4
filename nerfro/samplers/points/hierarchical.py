"""Hierarchical sampling on arc length (paper, section 2): fine samples where the coarse rendering has weight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.allowed import NotNegative, Range
from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.registry import register
from nerfro.samplers.base import PointSampler
from nerfro.samplers.points.stepfun import blur_weights, invert_cdf, midpoints, spread_uniform
from nerfro.samplers.points.stratified import Stratified, cone_samples, point_samples
from nerfro.types import Path, Rendering, Samples


@register("sampler/points", "hierarchical")
class Hierarchical(PointSampler):
    """Draw coarse stratified samples, and fine samples by inverse transform sampling of the coarse weights.

    Fine arc lengths are mapped to the path by the nearest previous vertex, so that fine samples lie on the bent ray
    (paper, Fig. 3).

    Args:
        num_coarse: number of coarse samples, N_c.
        num_fine: number of fine samples, N_f.
        union: whether to render the sorted union of both (NeRF, the paper) or only the fine samples (mip-NeRF).
        blur: whether to apply the max-blur of mip-NeRF to the coarse weights.
        padding: weight added to each bin before sampling; 0.01 in mip-NeRF, 0 in the authors' code.
        draw, cast, offset, box_min, box_max: options of the coarse samples, see `stratified`.
    """

    num_levels = 2

    def __init__(
        self,
        num_coarse: Annotated[int, Range(at_least=4, at_most=8192)] = 64,
        num_fine: Annotated[int, Range(at_least=1, at_most=8192)] = 128,
        union: bool = True,
        blur: bool = False,
        padding: NotNegative = 0.0,
        draw: Literal["arc_length", "vertices"] = "arc_length",
        cast: Literal["points", "cones"] = "points",
        offset: Annotated[float, Range(at_least=0, less_than=1)] = 0.5,
        box_min: Sequence[float] = (),
        box_max: Sequence[float] = (),
    ) -> None:
        super().__init__()
        if cast == "cones" and union:
            raise NerfroError("sampler/points: cones are not merged with coarse ones; set union=false")
        self.coarse = Stratified(num_coarse, draw, cast, offset, box_min, box_max)
        self.num_fine, self.union, self.blur, self.padding, self.cast = num_fine, union, blur, padding, cast

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        if previous is None:
            return self.coarse(path, None, draws)
        if self.cast == "cones":
            u = spread_uniform(path, self.num_fine + 1, draws, "fine samples")
            return cone_samples(path, self._draw(previous.samples.edges, previous.weights, u))
        # Weights belong to samples, so the bins of the distribution lie between the midpoints of samples.
        u = spread_uniform(path, self.num_fine, draws, "fine samples")
        s = self._draw(midpoints(previous.samples.s), previous.weights[:, 1:-1], u)
        if self.union:
            s = torch.cat([previous.samples.s, s], dim=1)
        return point_samples(path, s.sort(dim=1).values)

    @torch.no_grad()
    def _draw(
        self, edges: Float[Tensor, "R E"], weights: Float[Tensor, "R E-1"], u: Float[Tensor, "R N"]
    ) -> Float[Tensor, "R N"]:
        weights = weights.detach().to(edges.dtype)
        weights = blur_weights(weights, self.padding) if self.blur else weights + self.padding
        return invert_cdf(edges, weights, u)
