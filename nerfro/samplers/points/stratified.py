"""Stratified sampling of straight and bent paths (paper, Eqn. 2), and sampling from step functions on intervals."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le, Lt
from jaxtyping import Float
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.types import Path, Rendering, Samples
from nerfro.geometry.space import Space, Unbounded
from nerfro.registry.registration import register
from nerfro.samplers.base import PointSampler

# Width of the interval of the last point sample, behind which the background is seen: in world units for
# `draw=vertices`, as in the authors' code, and relative to the length of the path for other arc lengths.
LAST_DELTA = 1e-3
LAST_FRACTION = LAST_DELTA / 4  # rays of the authors' scenes are 4 units long


def spread_uniform(path: Path, num_samples: int, draws: Draws | None, stream: str = "samples") -> Float[Tensor, "P N"]:
    """Spread numbers over [0, 1), ascending along each polyline.

    With `draws`, there is one uniform number in each of `num_samples` equal bins (paper, Eqn. 2). Without, the
    numbers are evenly spaced and include both ends, 0 and 1 - eps, as the authors' code does in evaluation.
    """
    like = path.s
    if draws is not None:
        jitter = draws.for_rays(path.ray, num_samples, stream).to(like)
        return (torch.arange(num_samples, device=like.device, dtype=like.dtype) + jitter) / num_samples
    eps = torch.finfo(like.dtype).eps
    return torch.linspace(0.0, 1.0 - eps, num_samples, device=like.device, dtype=like.dtype).expand(len(like), -1)


def invert_cdf(
    edges: Float[Tensor, "P E"], weights: Float[Tensor, "P E-1"], u: Float[Tensor, "P N"]
) -> Float[Tensor, "P N"]:
    """Sample a step function by inversion of its cumulative distribution (paper, Eqn. 3).

    Args:
        edges: bounds of the intervals, ascending.
        weights: weight of each interval, in which the density is constant; the sum need not be 1.
        u: values of the cumulative distribution in [0, 1).

    Returns:
        Positions, which ascend if `u` ascends.
    """
    num_bins = weights.shape[-1]
    total = weights.sum(-1, keepdim=True)
    # Rays with a smaller total weight are sampled uniformly, as in the code of mip-NeRF.
    padding = (1e-5 - total).clamp(min=0)
    pdf = (weights + padding / num_bins) / (total + padding)
    cdf = pdf[..., :-1].cumsum(-1).clamp(max=1.0)
    cdf = torch.cat([torch.zeros_like(total), cdf, torch.ones_like(total)], dim=-1)
    index = (torch.searchsorted(cdf, u.contiguous(), right=True) - 1).clamp(0, num_bins - 1)
    low, high = cdf.gather(-1, index), cdf.gather(-1, index + 1)
    fraction = ((u - low) / (high - low).clamp(min=torch.finfo(u.dtype).tiny)).clamp(0.0, 1.0)
    left, right = edges.gather(-1, index), edges.gather(-1, index + 1)
    return left + fraction * (right - left)


def midpoints(edges: Float[Tensor, "*rows E"]) -> Float[Tensor, "*rows E-1"]:
    """Return the middle of each interval."""
    return 0.5 * (edges[..., 1:] + edges[..., :-1])


@register("sampler/points", "stratified")
class Stratified(PointSampler):
    """Draw one sample in each of evenly spaced bins: at random in training, at a fixed position in evaluation.

    Args:
        num_samples: number of bins, N_c.
        draw: `arc_length` draws any arc length; `vertices` selects one of every S / N_c vertices, as the paper does,
            from near to far, and needs paths with a multiple of N_c vertices.
        cast: `points`, or `cones`, whose samples fill the bins (mip-NeRF).
        offset: position in the bin in evaluation, 0 for the start, 0.5 for the centre, less than 1.
        space: space in which arc lengths are drawn; None for the whole path.
    """

    num_levels = 1

    def __init__(
        self,
        num_samples: Annotated[int, Ge(2), Le(8192)] = 64,
        draw: Literal["arc_length", "vertices"] = "arc_length",
        cast: Literal["points", "cones"] = "points",
        offset: Annotated[float, Ge(0), Lt(1)] = 0.5,
        space: Space | None = None,
    ) -> None:
        super().__init__()
        if cast == "cones" and draw == "vertices":
            raise NerfroError("sampler/points: cones have no vertices to draw; set draw=arc_length")
        self.num_samples, self.draw, self.cast, self.offset = num_samples, draw, cast, offset
        self.space = Unbounded() if space is None else space

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        if self.draw == "vertices":
            return self._draw_vertices(path, draws)
        near, far = self.space.span(path)
        if self.cast == "cones":
            return cone_samples(path, near[:, None] + self._cone_fractions(path, draws) * (far - near)[:, None])
        bins = torch.arange(self.num_samples, device=path.s.device, dtype=path.s.dtype)
        fractions = (bins + self._offsets(path, draws)) / self.num_samples
        return point_samples(path, near[:, None] + fractions * (far - near)[:, None])

    def _offsets(self, path: Path, draws: Draws | None) -> Float[Tensor, "P N"]:
        if draws is not None:
            return draws.for_rays(path.ray, self.num_samples).to(path.s)
        return path.s.new_full((len(path.s), self.num_samples), self.offset)

    def _cone_fractions(self, path: Path, draws: Draws | None) -> Float[Tensor, "P E"]:
        like = path.s
        fractions = torch.linspace(0.0, 1.0, self.num_samples + 1, device=like.device, dtype=like.dtype)
        if draws is not None:  # as in mip-NeRF, each edge moves by up to half a bin
            middle = midpoints(fractions)
            low, high = torch.cat([fractions[:1], middle]), torch.cat([middle, fractions[-1:]])
            return low + (high - low) * draws.for_rays(path.ray, len(fractions)).to(like)
        return fractions.expand(len(like), -1)

    def _draw_vertices(self, path: Path, draws: Draws | None) -> Samples:
        steps, remainder = divmod(path.s.shape[1], self.num_samples)
        if steps == 0 or remainder:
            raise NerfroError(
                f"sampler/points: draw=vertices needs a multiple of {self.num_samples} path vertices, this path has "
                f"{path.s.shape[1]}; set sampler.path.num_steps to a multiple, or draw=arc_length"
            )
        offsets = (self._offsets(path, draws) * steps).long()  # floor: 0 .. steps - 1
        vertex = torch.arange(self.num_samples, device=path.s.device) * steps + offsets
        s = path.s.gather(1, vertex)
        positions, directions = (x.take_along_dim(vertex[..., None], 1) for x in (path.positions, path.directions))
        return Samples(positions, directions, s, torch.cat([s, s[:, -1:] + LAST_DELTA], dim=1), path.radii)


def point_samples(path: Path, s: Float[Tensor, "P N"], last: float | None = None) -> Samples:
    """Create samples at given arc lengths.

    Args:
        path: P polylines.
        s: arc lengths [P, N] in ascending order along each polyline, world units.
        last: width of the last interval, world units; by default `LAST_FRACTION` of the path.

    Returns:
        Samples with positions and directions on the paths. The interval of each sample ends at the next sample.
    """
    width = LAST_FRACTION * (path.far - path.near) if last is None else torch.full_like(path.near, last)
    return Samples.along(path, s, torch.cat([s, s[:, -1:] + width[:, None]], dim=1))


def cone_samples(path: Path, edges: Float[Tensor, "P E"]) -> Samples:
    """Create samples at the middle of intervals between ascending edges."""
    return Samples.along(path, midpoints(edges), edges)
