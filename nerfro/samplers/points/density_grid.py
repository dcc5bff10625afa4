"""Importance sampling by a grid of the field's density, which replaces a coarse network at the cost of a lookup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.compositing import volume_weights
from nerfro.core.draws import Draws
from nerfro.core.types import Path, Rendering, Samples
from nerfro.fields.base import Field
from nerfro.geometry.space import Space
from nerfro.kernels.operators import arrays, select
from nerfro.kernels.threads import share_parts
from nerfro.registry.allowed import Count, Share
from nerfro.registry.registration import register
from nerfro.samplers.base import PointSampler
from nerfro.samplers.points.stratified import invert_cdf, midpoints, spread_uniform

# Smallest optical depth, predicted by the grid, of samples at which the field is queried.
_EMPTY = 0.005
# In training: number of samples on branches of the smallest weight, and the weight from which all samples are queried.
_MIN_SAMPLES, _HEAVY = 8, 0.5


@register("sampler/points", "density_grid")
class DensityGridSampler(PointSampler):
    """Draw samples in proportion to the rendering weights that a grid of the field's density predicts.

    The grid covers the box of the space. Each cell keeps the largest density that was found in it, with exponential
    decay, and a fraction of the cells is updated from the finest field at regular steps of training. This is the
    occupancy grid of Instant-NGP (Mueller et al. 2022, appendix C), but it keeps densities, so that samples can be
    drawn from them along a bent path. The predicted weights include transmittance, so that few samples lie behind
    opaque cells. A fraction of the samples is spread evenly, so that no region is left out. In contracted space,
    samples reach from `Space.near` to practical infinity, and evenly means evenly in contracted length.

    Args:
        space: space of the samples; it has a box.
        num_samples: number of intervals on each path.
        num_bins: number of bins along the path at whose midpoints the grid is queried.
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
    needs_box = True
    density: Float[Tensor, "cells cells cells"]
    inside: Int[Tensor, "M"] | None  # numbers of the cells that updates query; None for all

    def __init__(
        self,
        space: Space,
        num_samples: Annotated[int, Ge(1), Le(8192)] = 32,
        num_bins: Annotated[int, Ge(2), Le(8192)] = 96,
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
        self.space = space
        self.register_buffer("density", torch.zeros(resolution, resolution, resolution))
        self.register_buffer("inside", space.cells(resolution), persistent=False)

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        samples = self.choose_ahead(path, draws)
        # The kernel returns positions without gradients, which only some paths have.
        return samples.on(path) if path.positions.requires_grad else samples

    @torch.no_grad()
    def choose_ahead(self, path: Path, draws: Draws | None) -> Samples:
        samples = select(path.s, self.draw_compiled, self.draw)(path, draws)
        return samples if draws is None else replace(samples, occupied=self._queried(path, samples))

    def _num_intervals(self, path: Path) -> Int[Tensor, "P"]:
        """Number of intervals of each polyline in training: in proportion to its weight, if rays split.

        Missing intervals are at the end of a polyline and have no length.
        """
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
        space, dtype = self.space, path.s.dtype
        if draws is None:
            u = spread_uniform(path, self.num_samples_evaluation + 1, None)
        else:
            num = self._num_intervals(path)[:, None]
            edge = torch.arange(self.num_samples + 1, device=num.device).minimum(num)
            u = (edge + draws.for_rays(path.ray, self.num_samples + 1).gather(1, edge)) / (num + 1)
        total, arc_length = space.measure(path)
        places = torch.linspace(0, 1, self.num_bins + 1, device=u.device) * total[:, None]
        positions, _ = path.at(arc_length(midpoints(places)).to(dtype))
        most = -math.log1p(-self.max_bin_alpha) if self.max_bin_alpha < 1 else math.inf
        estimated = (self.lookup(space.contract(positions)) * places.diff(dim=1)).clamp(max=most)
        weights, _ = volume_weights(estimated, torch.ones_like(estimated))
        share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-6)
        places = invert_cdf(places, share + self._floor, u)
        middles, edges = (arc_length(at).to(dtype) for at in (midpoints(places), places))
        samples, widths = Samples.along(path, middles, edges), places.diff(dim=1)
        depth = self.lookup(space.contract(samples.positions)) * widths
        lengths = (widths / space.scale(samples.positions)).to(dtype)
        return self._samples(replace(samples, occupied=depth >= _EMPTY), lengths, places.to(dtype))

    def _samples(
        self, samples: Samples, lengths: Float[Tensor, "P N"], contracted_edges: Float[Tensor, "P N+1"]
    ) -> Samples:
        """Add the contracted lengths of samples, if space is contracted."""
        return replace(samples, lengths=lengths, contracted_edges=contracted_edges) if self.space.infinite else samples

    def draw_compiled(self, path: Path, draws: Draws | None) -> Samples:
        """Draw the samples of `draw` on the CPU."""
        from nerfro.samplers.points.density_grid_cpu import Settings, draw  # compiled code, so only where it is used

        if draws is None:
            num_samples, of_path, key = self.num_samples_evaluation, (path.ray[:0], path.ray[:0]), (0, 0, 0, 0)
        else:
            num_samples, key = self.num_samples, draws.counters("samples")
            of_path = draws.ray[path.ray], self._num_intervals(path)
        settings = Settings(
            self.num_bins, self._floor, self.max_bin_alpha, _EMPTY, self.space.radius, self.space.near or 0.0
        )
        paths, box = arrays(path.positions, path.directions, path.s), tuple(arrays(*self.space.box))
        [density], random = arrays(self.density), arrays(*of_path)

        def draw_part(part: slice) -> tuple[np.ndarray, ...]:
            paths_of_part, random_of_part = (tuple(values[part] for values in group) for group in (paths, random))
            return draw(paths_of_part, box, density, (*random_of_part, key), num_samples, settings)

        fields = zip(*share_parts(draw_part, len(path.s)), strict=True)
        edges, s, positions, directions, occupied, *contracted = (
            torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts)) for parts in fields
        )
        return self._samples(Samples(positions, directions, s, edges, path.radii, occupied), *contracted)

    @property
    def _floor(self) -> float:
        """Weight of each bin that spreads the fraction `uniform` of the samples evenly, where weights sum to one."""
        return self.uniform / (1 - self.uniform) / self.num_bins

    def lookup(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Density of the cell at each contracted position, per unit of contracted length."""
        low, high = self.space.box
        cell = ((positions - low) / (high - low) * self.resolution).long()
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
        side = self.resolution  # torch.unravel_index would copy the shape to the device
        corners = torch.stack([cells // side**2, cells // side % side, cells % side], -1)
        unit = (corners + (words[:, 1:] >> 8) * 2.0**-24) / side
        low, high = self.space.box
        contracted = low + unit * (high - low)
        positions = self.space.expand(contracted)
        density = fields[-1].density(positions) / self.space.scale(positions)  # per unit of contracted length
        density = torch.where(self.space.exists(contracted), density, 0.0)
        flat = self.density.view(-1)
        # A cell that is drawn twice must not depend on the order of writing, because runs must be repeatable.
        flat[cells] = flat[cells] * self.decay
        flat.scatter_reduce_(0, cells, density.to(flat), "amax")


def _weight(path: Path) -> Float[Tensor, "P"]:
    """Largest throughput of each polyline over the channels, at most 1."""
    return path.throughput.amax(-1).clamp(max=1)
