"""Sampling where a remembered density says that something is: the role of a coarse network, at the cost of a lookup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.allowed import Count, NotNegative, Positive, Range, Share, corners_of_box
from nerfro.draws import Draws
from nerfro.fields.base import Field
from nerfro.geometry.contraction import contract, contracted_box, contraction_scale, expand
from nerfro.kernels.arrays import arrays
from nerfro.registry import register
from nerfro.rendering import volume_weights
from nerfro.samplers.base import PointSampler
from nerfro.samplers.measures import Contracted, WithinBox
from nerfro.samplers.stepfun import invert_cdf, midpoints, spread_uniform
from nerfro.samplers.stratified import cone_samples
from nerfro.types import Path, Rendering, Samples

# Remembered optical depth below which a sample of a picture is not worth asking the field.
_EMPTY = 0.005
# In training: samples of the faintest branches, and the weight from which a branch is asked everywhere.
_FEWEST, _HEAVY = 8, 0.5


@register("sampler/points", "density_grid")
class DensityGridSampler(PointSampler):
    """Inverse transform sampling of weights that a grid of the field's density predicts on arc length.

    The grid lies over the content's box. It remembers the largest density found in each cell, decaying, and looks at
    some cells of the finest field now and then while training (Instant-NGP's occupancy grid, appendix C, kept as
    density so that it can be drawn from along a bent path). Weights include transmittance, so that nothing is sampled
    behind what is opaque, and a share of the samples stays uniform, so that nothing is forgotten.

    Args:
        num_samples: intervals on each path.
        num_bins: places along the path at which the grid is asked.
        box_min, box_max: corners of the content's box; nothing is sampled outside.
        radius: of a ball around the box's middle, world units, to sample all of space instead, evenly in the length
            that paths have where what is beyond the ball is contracted (see `field=hash_grid`); none for the box alone.
        near: arc length at which samples begin then, whatever the path's; they go on to practical infinity.
        resolution: cells of the grid along each side.
        uniform: share of the samples that are spread evenly.
        every: steps between two looks at the field.
        looks: share of the cells that are looked at then, drawn at random; of those in which places of the world lie.
        decay: factor of a cell's remembered density at each look.
        trust: most of the light that one bin is believed to stop. A cell remembers its densest place, but many rays
            cross it elsewhere, and what they meet behind it would get next to no samples if the cell were opaque.
        num_shown: intervals in evaluation, where noise does not average out over steps; none for as many.
    """

    num_levels = 1
    box: Float[Tensor, "2 3"]
    density: Float[Tensor, "C C C"]
    inside: Int[Tensor, "P"] | None  # numbers of the cells that are looked at; none for all

    def __init__(
        self,
        num_samples: Annotated[int, Range(at_least=1, at_most=8192)] = 32,
        num_bins: Annotated[int, Range(at_least=2, at_most=8192)] = 96,
        box_min: list[float] = (-1.0, -1.0, -1.0),  # type: ignore[assignment]
        box_max: list[float] = (1.0, 1.0, 1.0),  # type: ignore[assignment]
        radius: Positive | None = None,
        near: NotNegative = 0.0,
        resolution: Annotated[int, Range(at_least=2, at_most=1024)] = 64,
        uniform: Share = 0.2,
        every: Count = 16,
        looks: Share = 1 / 16,
        decay: Share = 0.9,
        trust: Annotated[float, Range(more_than=0, at_most=1)] = 0.4,
        num_shown: Annotated[int, Range(at_least=1, at_most=8192)] | None = None,
    ) -> None:
        super().__init__()
        self.num_samples, self.num_bins, self.resolution = num_samples, num_bins, resolution
        self.uniform, self.every, self.looks, self.decay = uniform, every, looks, decay
        self.trust, self.num_shown = trust, num_shown
        self.radius, self.near = radius, near
        box = torch.from_numpy(corners_of_box(box_min, box_max)).float()
        self.register_buffer("box", box if radius is None else contracted_box(box, radius), persistent=False)
        self.register_buffer("density", torch.zeros(resolution, resolution, resolution))
        inside = None if radius is None else _cells_of_the_world(resolution)
        self.register_buffer("inside", inside, persistent=False)

    def forward(self, path: Path, previous: Rendering | None, draws: Draws | None = None) -> Samples:
        with torch.no_grad():
            draw = self.draw_compiled if path.s.device.type == "cpu" else self.draw
            samples = draw(path, draws)
            if draws is not None:
                samples = replace(samples, occupied=self._asked(path, samples))
        # The kernel has found positions too; they are asked of the path only where it has gradients to give.
        if not path.positions.requires_grad:
            return samples
        along = Samples.along(path, samples.s, samples.edges)
        return replace(along, occupied=samples.occupied, lengths=samples.lengths, measure=samples.measure)

    def _quantiles(self, path: Path, draws: Draws | None) -> Float[Tensor, "P N+1"]:
        """Compute the values of the cumulative weights at which edges of samples lie.

        In training, polylines of rays that split get samples in proportion to their weight. The intervals that one
        lacks are at its end and have no length.
        """
        if draws is None:
            return spread_uniform(path, (self.num_shown or self.num_samples) + 1, None)
        num = self._num_intervals(path)[:, None]
        edge = torch.arange(self.num_samples + 1, device=num.device).minimum(num)
        return (edge + draws.for_rays(path.ray, self.num_samples + 1).gather(1, edge)) / (num + 1)

    def _num_intervals(self, path: Path) -> Int[Tensor, "P"]:
        """Number of intervals of each polyline in training."""
        if not path.splits:
            return torch.full_like(path.ray, self.num_samples)
        return (self.num_samples * _weight(path)).ceil().clamp(min=min(self.num_samples, _FEWEST)).long()

    @staticmethod
    def _asked(path: Path, samples: Samples) -> Bool[Tensor, "P N"] | None:
        """Which samples the field is asked at in training: all but those of faint branches where nothing is remembered.

        The field may have grown since the grid has looked; heavy branches find that out.
        """
        if not path.splits:
            return None
        assert samples.occupied is not None
        return ((_weight(path) >= _HEAVY)[:, None] | samples.occupied) & (samples.deltas > 0)

    def draw(self, path: Path, draws: Draws | None) -> Samples:
        """Draw samples with PyTorch; the reference implementation of the compiled kernel."""
        u = self._quantiles(path, draws)
        if self.radius is None:
            measure: WithinBox | Contracted = WithinBox.of(path, self.box)
        else:
            measure = Contracted.of(path, self.centre, self.radius, self.near)
        places = torch.linspace(0, 1, self.num_bins + 1, device=u.device) * measure.total[:, None]
        positions, _ = path.at(measure.arc_length(midpoints(places)).to(path.s.dtype))
        believed = (self.lookup(self.contracted(positions)) * places.diff(dim=1)).clamp(max=self._deepest)
        weights, _ = volume_weights(believed, torch.ones_like(believed))
        share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-6)
        places = invert_cdf(places, share + self._floor, u)
        edges = measure.arc_length(places).to(path.s.dtype)
        if self.radius is None:
            samples = cone_samples(path, edges)
        else:
            samples = Samples.along(path, measure.arc_length(midpoints(places)).to(path.s.dtype), edges)
            smaller = contraction_scale(samples.positions, self.centre, self.radius)
            lengths = (places.diff(dim=1) / smaller).to(path.s.dtype)
            samples = replace(samples, lengths=lengths, measure=places.to(path.s.dtype))
        depth = self.lookup(self.contracted(samples.positions)) * places.diff(dim=1)
        return replace(samples, occupied=depth >= _EMPTY)

    def draw_compiled(self, path: Path, draws: Draws | None) -> Samples:
        """Draw the samples of `draw` on the CPU."""
        from nerfro.samplers.density_grid_cpu import draw  # compiled code, so only where it is used

        if draws is None:
            num_samples, of_path, key = self.num_shown or self.num_samples, (path.ray[:0], path.ray[:0]), (0, 0, 0, 0)
        else:
            of_path = draws.ray[path.ray], self._num_intervals(path)
            num_samples, key = self.num_samples, draws.counters("samples")
        tensors = path.positions, path.directions, path.s, *self.box, self.density, *of_path
        settings = self.num_bins, self._floor, self.trust, _EMPTY, self.radius or 0.0, self.near
        arguments: list[Any] = [*arrays(*tensors), key, num_samples, *settings]
        drawn = draw(*arguments)
        edges, s, positions, directions, occupied, *of_measure = (torch.from_numpy(array) for array in drawn)
        lengths, measure = (None, None) if self.radius is None else of_measure
        return Samples(positions, directions, s, edges, path.radii, occupied, lengths, measure)

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return self.box.mean(0)

    def contracted(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Where the grid has what is at these positions of the world."""
        return positions if self.radius is None else contract(positions, self.centre, self.radius)

    @property
    def _deepest(self) -> float:
        """Optical depth of a bin that stops as much light as one is believed to stop."""
        return -math.log1p(-self.trust) if self.trust < 1 else math.inf

    @property
    def _floor(self) -> float:
        """Weight of each bin that makes `uniform` of the samples even, when the shares sum to one."""
        return self.uniform / (1 - self.uniform) / self.num_bins

    def lookup(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Remembered density of the cell that each position of the grid lies in; per contracted length."""
        cell = ((positions - self.box[0]) / (self.box[1] - self.box[0]) * self.resolution).long()
        x, y, z = cell.clamp(0, self.resolution - 1).unbind(-1)
        return self.density.view(-1)[(x * self.resolution + y) * self.resolution + z]

    @torch.no_grad()
    def after_step(self, fields: Sequence[Field], draws: Draws) -> None:
        """Look at some of the cells, at a random place in each."""
        if draws.step % self.every:
            return
        device, inside = self.density.device, self.inside
        num_cells = self.resolution**3 if inside is None else len(inside)
        words = draws.words(torch.arange(int(num_cells * self.looks), device=device), 4, "density grid")
        cells = words[:, 0] * num_cells >> 32
        cells = cells if inside is None else inside[cells]
        corners = torch.stack(
            [cells // self.resolution**2, cells // self.resolution % self.resolution, cells % self.resolution], dim=-1
        )
        unit = (corners + (words[:, 1:] >> 8) * 2.0**-24) / self.resolution
        places = self.box[0] + unit * (self.box[1] - self.box[0])
        found = self._look(fields[-1], places)
        flat = self.density.view(-1)
        # A cell that was drawn twice must not depend on the order of writing, or runs could not be repeated.
        flat[cells] = flat[cells] * self.decay
        flat.scatter_reduce_(0, cells, found, "amax")

    def _look(self, field: Field, places: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
        """A field's density at places of the grid."""
        if self.radius is None:
            return field.density(places)
        positions = expand(places, self.centre, self.radius)
        outside = (places - self.centre).norm(dim=-1) >= 2 * self.radius  # where no place of the world lies
        density = field.density(positions) / contraction_scale(positions, self.centre, self.radius)
        return torch.where(outside, 0.0, density)


def _weight(path: Path) -> Float[Tensor, "P"]:
    """Share of its ray's light that a polyline brings, of the colour of which it brings most."""
    return path.throughput.amax(-1).clamp(max=1)


def _cells_of_the_world(resolution: int) -> Int[Tensor, "P"]:
    """Cells of the cube around contracted space, but for those in its corners, in which no place of the world lies."""
    edges = torch.linspace(-1, 1, resolution + 1).square()
    nearest = torch.minimum(edges[:-1], edges[1:])
    return ((nearest[:, None, None] + nearest[:, None] + nearest).flatten() < 1).nonzero()[:, 0]
