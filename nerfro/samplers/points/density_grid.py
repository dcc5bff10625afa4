"""Importance sampling by a grid of the field's density, which replaces a coarse network at the cost of a lookup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.types import Path, Rendering, Samples
from nerfro.fields.base import Field
from nerfro.geometry.box import corners_of_box
from nerfro.geometry.contraction import (
    FAR,
    contract,
    contracted_box,
    contracted_length,
    contraction_scale,
    expand,
    world_length,
)
from nerfro.kernels.arrays import arrays
from nerfro.registry.allowed import Count, NotNegative, Positive, Share
from nerfro.registry.registration import register
from nerfro.samplers.base import PointSampler
from nerfro.samplers.points.stepfun import invert_cdf, midpoints, spread_uniform, volume_weights
from nerfro.samplers.points.stratified import cone_samples

# Smallest optical depth, predicted by the grid, of samples at which the field is queried.
_EMPTY = 0.005
# In training: number of samples on branches of the smallest weight, and the weight from which all samples are queried.
_MIN_SAMPLES, _HEAVY = 8, 0.5


@dataclass(frozen=True)
class ContractedLength:
    """Length of a polyline in contracted space, from `near` to practical infinity.

    If necessary, the first segment is extended backwards, and the last one forwards, beyond the ends of the path.

    Attributes:
        cumulative: contracted length at the start of each segment, and in total.
        start_length: signed contracted length from the segment's closest approach to its start.
        closest: arc length of the segment's closest approach to the centre.
        impact: distance of the closest approach from the centre (impact parameter).
        radius: radius of the ball beyond which space is contracted.
    """

    cumulative: Float[Tensor, "P segment_ends"]
    start_length: Float[Tensor, "P S"]
    closest: Float[Tensor, "P S"]
    impact: Float[Tensor, "P S"]
    radius: float

    @classmethod
    def of(cls, path: Path, centre: Float[Tensor, "3"], radius: float, near: float) -> ContractedLength:
        positions, directions, s = (x.detach().double() for x in (path.positions, path.directions, path.s))
        offsets = centre - positions
        along = (offsets * directions).sum(-1)
        impact = (offsets.square().sum(-1) - along.square()).clamp(min=0).sqrt()
        closest = s + along
        start = torch.cat([s[:, 1:2].clamp(max=near), s[:, 1:]], 1)
        end = torch.cat([s[:, 1:], closest[:, -1:] + FAR * impact[:, -1:].clamp(min=radius)], 1)
        start_length = contracted_length(start - closest, impact, radius)
        lengths = contracted_length(end - closest, impact, radius) - start_length
        cumulative = torch.cat([torch.zeros_like(lengths[:, :1]), lengths.cumsum(1)], 1)
        return cls(cumulative, start_length, closest, impact, radius)

    @property
    def total(self) -> Float[Tensor, "P"]:
        return self.cumulative[:, -1]

    def arc_length(self, length: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
        """Convert contracted lengths from 0 to `total` to arc lengths."""
        last = self.start_length.shape[1] - 1
        segment = (torch.searchsorted(self.cumulative, length.contiguous().double()) - 1).clamp(0, last)
        start_length, closest, impact, before = (
            x.gather(1, segment) for x in (self.start_length, self.closest, self.impact, self.cumulative)
        )
        return closest + world_length(start_length + length - before, impact, self.radius)


@register("sampler/points", "density_grid")
class DensityGridSampler(PointSampler):
    """Draw samples in proportion to the rendering weights that a grid of the field's density predicts.

    The grid covers the box of the content. Each cell keeps the largest density that was found in it, with exponential
    decay, and a fraction of the cells is updated from the finest field at regular steps of training. This is the
    occupancy grid of Instant-NGP (Mueller et al. 2022, appendix C), but it keeps densities, so that samples can be
    drawn from them along a bent path. The predicted weights include transmittance, so that few samples lie behind
    opaque cells. A fraction of the samples is spread evenly, so that no region is left out.

    Args:
        num_samples: number of intervals on each path.
        num_bins: number of bins along the path at whose midpoints the grid is queried.
        box_min, box_max: corners of the content's box, world units; there are no samples outside.
        radius: radius of a ball around the middle of the box, world units. With it, samples cover all of space, evenly
            in the length of the path in space that is contracted outside the ball (see `field=hash_grid`). None for the
            box alone.
        near: arc length at which samples begin if there is a radius, or less if a surface is closer; they reach
            practical infinity.
        resolution: cells along each side of the grid.
        uniform: fraction of the samples that is spread evenly.
        update_every: training steps between two updates of the grid.
        update_fraction: fraction of the cells that an update queries, drawn at random.
        decay: factor of the density of a cell at each update.
        max_bin_alpha: upper bound on the opacity (alpha) of one bin. A cell stores the density of its densest point,
            which many rays miss; without the bound, these rays would have hardly any samples behind the cell.
        num_samples_evaluation: number of intervals in evaluation, where noise does not average out over steps; None
            for `num_samples`.
    """

    num_levels = 1
    box: Float[Tensor, "2 3"]
    density: Float[Tensor, "cells cells cells"]
    inside: Int[Tensor, "M"] | None  # numbers of the cells that updates query; None for all

    def __init__(
        self,
        num_samples: Annotated[int, Ge(1), Le(8192)] = 32,
        num_bins: Annotated[int, Ge(2), Le(8192)] = 96,
        box_min: Sequence[float] = (-1.0, -1.0, -1.0),
        box_max: Sequence[float] = (1.0, 1.0, 1.0),
        radius: Positive | None = None,
        near: NotNegative = 0.0,
        resolution: Annotated[int, Ge(2), Le(1024)] = 64,
        uniform: Share = 0.2,
        update_every: Count = 16,
        update_fraction: Share = 1 / 16,
        decay: Share = 0.9,
        max_bin_alpha: Annotated[float, Gt(0), Le(1)] = 0.4,
        num_samples_evaluation: Annotated[int, Ge(1), Le(8192)] | None = None,
    ) -> None:
        super().__init__()
        self.num_samples, self.num_bins, self.resolution = num_samples, num_bins, resolution
        self.uniform, self.decay, self.max_bin_alpha = uniform, decay, max_bin_alpha
        self.update_every, self.update_fraction = update_every, update_fraction
        self.num_samples_evaluation = num_samples if num_samples_evaluation is None else num_samples_evaluation
        self.radius, self.near = radius, near
        box = torch.from_numpy(corners_of_box(box_min, box_max)).float()
        self.register_buffer("box", box if radius is None else contracted_box(box, radius), persistent=False)
        self.register_buffer("density", torch.zeros(resolution, resolution, resolution))
        inside = None if radius is None else _cells_in_ball(resolution)
        self.register_buffer("inside", inside, persistent=False)

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        samples = self._chosen(path, draws) if path.samples is None else path.samples
        # The kernel returns positions without gradients, which only some paths have.
        if not path.positions.requires_grad:
            return samples
        along = Samples.along(path, samples.s, samples.edges)
        contracted_edges = samples.contracted_edges
        return replace(along, occupied=samples.occupied, lengths=samples.lengths, contracted_edges=contracted_edges)

    def choose_ahead(self, path: Path, draws: Draws) -> Path:
        return replace(path, samples=self._chosen(path, draws))

    @torch.no_grad()
    def _chosen(self, path: Path, draws: Draws | None) -> Samples:
        samples = (self.draw_compiled if path.s.device.type == "cpu" else self.draw)(path, draws)
        return samples if draws is None else replace(samples, occupied=self._queried(path, samples))

    def _quantiles(self, path: Path, draws: Draws | None) -> Float[Tensor, "P E"]:
        """Compute the values of the cumulative weights at which edges of samples lie.

        In training, polylines of rays that split have samples in proportion to their weight. Missing intervals are at
        the end of a polyline and have no length.
        """
        if draws is None:
            return spread_uniform(path, self.num_samples_evaluation + 1, None)
        num = self._num_intervals(path)[:, None]
        edge = torch.arange(self.num_samples + 1, device=num.device).minimum(num)
        return (edge + draws.for_rays(path.ray, self.num_samples + 1).gather(1, edge)) / (num + 1)

    def _num_intervals(self, path: Path) -> Int[Tensor, "P"]:
        """Number of intervals of each polyline in training."""
        if not path.splits:
            return torch.full_like(path.ray, self.num_samples)
        return (self.num_samples * _weight(path)).ceil().clamp(min=min(self.num_samples, _MIN_SAMPLES)).long()

    @staticmethod
    def _queried(path: Path, samples: Samples) -> Bool[Tensor, "P N"] | None:
        """Samples at which the field is queried in training: all, except in empty cells on branches of small weight.

        Branches of large weight find density that is newer than the last update of the grid.
        """
        if not path.splits:
            return None
        assert samples.occupied is not None
        return ((_weight(path) >= _HEAVY)[:, None] | samples.occupied) & (samples.deltas > 0)

    def draw(self, path: Path, draws: Draws | None) -> Samples:
        """Draw samples with PyTorch; the reference implementation of the compiled kernel."""
        u = self._quantiles(path, draws)
        if self.radius is None:
            first, last = path.span(self.box)
            total = last - first
        else:
            contracted = ContractedLength.of(path, self.centre, self.radius, self.near)
            total = contracted.total

        def arc_length(length: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
            """Convert lengths from 0 to `total` to arc lengths."""
            return first[:, None] + length if self.radius is None else contracted.arc_length(length)

        places = torch.linspace(0, 1, self.num_bins + 1, device=u.device) * total[:, None]
        positions, _ = path.at(arc_length(midpoints(places)).to(path.s.dtype))
        estimated = (self.lookup(self.contracted(positions)) * places.diff(dim=1)).clamp(max=self._max_bin_depth)
        weights, _ = volume_weights(estimated, torch.ones_like(estimated))
        share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-6)
        places = invert_cdf(places, share + self._floor, u)
        edges = arc_length(places).to(path.s.dtype)
        if self.radius is None:
            samples = cone_samples(path, edges)
        else:
            samples = Samples.along(path, arc_length(midpoints(places)).to(path.s.dtype), edges)
            scale = contraction_scale(samples.positions, self.centre, self.radius)
            lengths = (places.diff(dim=1) / scale).to(path.s.dtype)
            samples = replace(samples, lengths=lengths, contracted_edges=places.to(path.s.dtype))
        depth = self.lookup(self.contracted(samples.positions)) * places.diff(dim=1)
        return replace(samples, occupied=depth >= _EMPTY)

    def draw_compiled(self, path: Path, draws: Draws | None) -> Samples:
        """Draw the samples of `draw` on the CPU."""
        from nerfro.samplers.points.density_grid_cpu import Settings, draw  # compiled code, so only where it is used

        if draws is None:
            num_samples, of_path, key = self.num_samples_evaluation, (path.ray[:0], path.ray[:0]), (0, 0, 0, 0)
        else:
            num_samples, key = self.num_samples, draws.counters("samples")
            of_path = draws.ray[path.ray], self._num_intervals(path)
        settings = Settings(self.num_bins, self._floor, self.max_bin_alpha, _EMPTY, self.radius or 0.0, self.near)
        paths, box = tuple(arrays(path.positions, path.directions, path.s)), tuple(arrays(*self.box))
        [density], random = arrays(self.density), (*arrays(*of_path), key)
        drawn = draw(paths, box, density, random, num_samples, settings)
        edges, s, positions, directions, occupied, *contracted = (torch.from_numpy(array) for array in drawn)
        lengths, contracted_edges = (None, None) if self.radius is None else contracted
        return Samples(positions, directions, s, edges, path.radii, occupied, lengths, contracted_edges)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return self.box.mean(0)

    def contracted(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Map positions in world space to the space of the grid."""
        return positions if self.radius is None else contract(positions, self.centre, self.radius)

    @property
    def _max_bin_depth(self) -> float:
        """Optical depth of a bin whose opacity is `max_bin_alpha`."""
        return -math.log1p(-self.max_bin_alpha) if self.max_bin_alpha < 1 else math.inf

    @property
    def _floor(self) -> float:
        """Weight of each bin that spreads the fraction `uniform` of the samples evenly, where weights sum to one."""
        return self.uniform / (1 - self.uniform) / self.num_bins

    def lookup(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Density of the cell at each position in the space of the grid, per unit of (contracted) length."""
        cell = ((positions - self.box[0]) / (self.box[1] - self.box[0]) * self.resolution).long()
        x, y, z = cell.clamp(0, self.resolution - 1).unbind(-1)
        return self.density.view(-1)[(x * self.resolution + y) * self.resolution + z]

    @torch.no_grad()
    def update(self, fields: Sequence[Field], draws: Draws) -> None:
        """Update some of the cells from the finest field, each at a random position in it."""
        if draws.step % self.update_every:
            return
        device, inside = self.density.device, self.inside
        num_cells = self.resolution**3 if inside is None else len(inside)
        words = draws.words(torch.arange(math.ceil(num_cells * self.update_fraction), device=device), 4, "density grid")
        cells = words[:, 0] * num_cells >> 32
        cells = cells if inside is None else inside[cells]
        corners = torch.stack(
            [cells // self.resolution**2, cells // self.resolution % self.resolution, cells % self.resolution], dim=-1
        )
        unit = (corners + (words[:, 1:] >> 8) * 2.0**-24) / self.resolution
        density = self._query(fields[-1], self.box[0] + unit * (self.box[1] - self.box[0]))
        flat = self.density.view(-1)
        # A cell that is drawn twice must not depend on the order of writing, because runs must be repeatable.
        flat[cells] = flat[cells] * self.decay
        flat.scatter_reduce_(0, cells, density.to(flat), "amax")

    def _query(self, field: Field, contracted: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
        """Density of a field at positions in the space of the grid."""
        if self.radius is None:
            return field.density(contracted)
        positions = expand(contracted, self.centre, self.radius)
        outside = (contracted - self.centre).norm(dim=-1) >= 2 * self.radius  # beyond infinity
        density = field.density(positions) / contraction_scale(positions, self.centre, self.radius)
        return torch.where(outside, 0.0, density)


def _weight(path: Path) -> Float[Tensor, "P"]:
    """Largest throughput of each polyline over the channels, at most 1."""
    return path.throughput.amax(-1).clamp(max=1)


def _cells_in_ball(resolution: int) -> Int[Tensor, "M"]:
    """Cells of the cube around contracted space that meet the ball; the others, in its corners, are beyond infinity."""
    edges = torch.linspace(-1, 1, resolution + 1).square()
    nearest = torch.minimum(edges[:-1], edges[1:])
    return ((nearest[:, None, None] + nearest[:, None] + nearest).flatten() < 1).nonzero()[:, 0]
