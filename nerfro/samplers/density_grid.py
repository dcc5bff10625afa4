"""Sampling where a remembered density says that something is: the role of a coarse network, at the cost of a lookup."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.allowed import Count, Range, Share, corners_of_box
from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.registry import register
from nerfro.rendering import volume_weights
from nerfro.samplers.base import PointSampler
from nerfro.samplers.stepfun import invert_cdf, spread_uniform
from nerfro.samplers.stratified import cone_samples
from nerfro.types import Path, Rendering, Samples

# Remembered optical depth below which a sample of a picture is not worth asking the field.
_EMPTY = 0.005


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
        resolution: cells of the grid along each side.
        uniform: share of the samples that are spread evenly.
        every: steps between two looks at the field.
        decay: factor of the remembered density at each look.
    """

    num_levels = 1
    box: Float[Tensor, "2 3"]
    density: Float[Tensor, "C C C"]

    def __init__(
        self,
        num_samples: Annotated[int, Range(at_least=1, at_most=8192)] = 32,
        num_bins: Annotated[int, Range(at_least=2, at_most=8192)] = 96,
        box_min: list[float] = (-1.0, -1.0, -1.0),  # type: ignore[assignment]
        box_max: list[float] = (1.0, 1.0, 1.0),  # type: ignore[assignment]
        resolution: Annotated[int, Range(at_least=2, at_most=1024)] = 64,
        uniform: Share = 0.2,
        every: Count = 16,
        decay: Share = 0.9,
    ) -> None:
        super().__init__()
        self.num_samples, self.num_bins, self.resolution = num_samples, num_bins, resolution
        self.uniform, self.every, self.decay = uniform, every, decay
        self.register_buffer("box", torch.from_numpy(corners_of_box(box_min, box_max)).float(), persistent=False)
        self.register_buffer("density", torch.zeros(resolution, resolution, resolution))

    def forward(self, path: Path, previous: Rendering | None) -> Samples:
        with torch.no_grad():
            u = spread_uniform(path, self.num_samples + 1, self.training)
            samples = self.draw_compiled(path, u) if path.s.device.type == "cpu" else self.draw(path, u)
        if self.training:  # the field may have grown since the grid has looked
            samples = replace(samples, occupied=None)
        # The kernel has found positions too; they are asked of the path only where it has gradients to give.
        return Samples.along(path, samples.s, samples.edges) if path.positions.requires_grad else samples

    def draw(self, path: Path, u: Float[Tensor, "R N+1"]) -> Samples:
        """Samples at places `u` of the cumulative weights: the plain reference of the compiled kernel."""
        near, far = path.span(self.box)
        fractions = torch.linspace(0, 1, self.num_bins + 1, device=near.device)
        edges = near[:, None] + fractions * (far - near)[:, None]
        positions, _ = path.at(0.5 * (edges[:, 1:] + edges[:, :-1]))
        weights, _ = volume_weights(self.lookup(positions), edges[:, 1:] - edges[:, :-1])
        share = weights / weights.sum(-1, keepdim=True).clamp(min=1e-6)
        samples = cone_samples(path, invert_cdf(edges, share + self._floor, u))
        return replace(samples, occupied=self.lookup(samples.positions) * samples.deltas >= _EMPTY)

    def draw_compiled(self, path: Path, u: Float[Tensor, "R N+1"]) -> Samples:
        """The same as `draw`, on the CPU.

        Raises:
            NerfroError: not one row of places for each path, which the kernel would read beyond their end.
        """
        if len(u) != len(path.s):
            raise NerfroError(f"{len(u)} rows of random numbers for {len(path.s)} paths; draw them with Path.rand")
        from nerfro.kernels.threads import use_threads
        from nerfro.samplers.density_grid_cpu import draw  # compiled code, so only where it is used

        use_threads()
        drawn = draw(
            path.positions.detach().contiguous().numpy(),
            path.directions.detach().contiguous().numpy(),
            path.s.detach().contiguous().numpy(),
            self.box[0].numpy(),
            self.box[1].numpy(),
            self.density.numpy(),
            u.contiguous().numpy(),
            self.num_bins,
            self._floor,
            _EMPTY,
        )
        edges, s, positions, directions, occupied = (torch.from_numpy(array) for array in drawn)
        return Samples(positions, directions, s, edges, path.radii, occupied)

    @property
    def _floor(self) -> float:
        """Weight of each bin that makes `uniform` of the samples even, when the shares sum to one."""
        return self.uniform / (1 - self.uniform) / self.num_bins

    def lookup(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Remembered density of the cell that each position lies in."""
        cell = ((positions - self.box[0]) / (self.box[1] - self.box[0]) * self.resolution).long()
        x, y, z = cell.clamp(0, self.resolution - 1).unbind(-1)
        return self.density.view(-1)[(x * self.resolution + y) * self.resolution + z]

    @torch.no_grad()
    def after_step(self, step: int, fields: Sequence[Field]) -> None:
        """Look at a random sixteenth of the cells, at a random place in each."""
        if step % self.every:
            return
        num_cells = self.resolution**3
        device = self.density.device
        cells = torch.randint(num_cells, (num_cells // 16,), device=device)
        corners = torch.stack(
            [cells // self.resolution**2, cells // self.resolution % self.resolution, cells % self.resolution], dim=-1
        )
        unit = (corners + torch.rand(len(cells), 3, device=device)) / self.resolution
        found = field_density(fields[-1], self.box[0] + unit * (self.box[1] - self.box[0]))
        flat = self.density.view(-1)
        # A cell that was drawn twice must not depend on the order of writing, or runs could not be repeated.
        flat[cells] = flat[cells] * self.decay
        flat.scatter_reduce_(0, cells, found, "amax")


def field_density(field: Field, positions: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
    """A field's density at points, seen from above; density does not depend on the direction."""
    directions = torch.zeros_like(positions)
    directions[:, 2] = -1
    s = torch.zeros(len(positions), 1, device=positions.device)
    samples = Samples(positions[:, None], directions[:, None], s, torch.cat([s, s], dim=1), s[:, 0])
    return field(samples).density[:, 0].float()
