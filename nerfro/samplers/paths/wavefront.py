"""Rays that are traced together from surface to surface, and split where light is partly reflected."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.core.types import Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.polylines import PolylineBuilder, SnellTrace, split
from nerfro.samplers.paths.replay import indices_of
from nerfro.samplers.paths.snell_law import reflectance, refract

# Attributes of `Wavefront` with one row for each polyline.
_COLUMNS = ("x", "d", "s", "inside", "moving", "ray", "weight", "num_events", "exceeded")


class _Crossing(NamedTuple):
    """Crossings of A rows: arguments of `Wavefront.apply_interface`, and the media on both sides."""

    before: Float[Tensor, "A"]
    after: Float[Tensor, "A"]
    body: Int[Tensor, "A L"]
    normal: Float[Tensor, "A 3"]
    flipped: Bool[Tensor, "A K"]  # whether the far side is inside each surface
    across: Int[Tensor, "A"]  # body on the far side, numbered from 1; 0 for air
    n_before: Float[Tensor, "A"]
    n_after: Float[Tensor, "A"]
    visible: Bool[Tensor, "A"]  # whether the index changes
    recorded: Bool[Tensor, "A"]  # whether the surface becomes a vertex: the index or the absorption changes

    def select(self, index: Tensor) -> _Crossing:
        return _Crossing(*(values[index] for values in self))


class Wavefront:
    """Rays on their way through bodies with sharp surfaces, one row for each polyline.

    Tracers find the next surface of each row. The wavefront applies Snell's law, follows branches, and records
    vertices.

    Args:
        rays: rays, in the precision and on the device of the computation.
        medium: bodies.
        box: box of the medium, as precise as the rays and on their device.
        max_events: largest number of refractions and reflections of a polyline.
        branching: which parts of light that is partly reflected are followed.

    Attributes:
        x, d: position in world units and unit direction of each row [P, 3].
        s: arc length from the camera [P].
        inside: whether each row is inside the surface of each body [P, K]; the tracers set the first values.
        moving: whether each row may intersect another surface.
        ray, weight: ray of each row, and its share of the light of this ray.
        num_events, exceeded: events of each row, and whether it met the limit.
        enter: arc length from near at which each ray enters the box.
    """

    def __init__(
        self,
        rays: Rays,
        medium: Bodies,
        box: Float[Tensor, "2 3"],
        max_events: int,
        branching: Branching,
    ) -> None:
        self.medium, self.box, self.max_events, self.branching = medium, box, max_events, branching
        self.indices, self.far = indices_of(medium, box), rays.far
        self.absorbs = functional.pad(medium.absorbs.to(box.device), (1, 0))
        self.x, self.d = rays.origins + rays.near[:, None] * rays.directions, rays.directions.clone()
        self.s = rays.near.clone()
        self.enter, leave = intersect_box(box, self.x, self.d)
        self.moving = (self.enter < leave) & (leave > 0) & (self.enter < rays.far - self.s)
        self.ray = torch.arange(len(rays), device=self.s.device)
        self.num_events = torch.zeros_like(self.ray)
        self.weight = torch.ones_like(self.s)
        self.exceeded = torch.zeros_like(self.moving)
        self.inside = self.exceeded[:, None].repeat(1, len(medium.iors))
        self.lines = PolylineBuilder(len(rays), self.x)

    def begin(self, inside: Callable[[Tensor], Bool[Tensor, "P K"]]) -> None:
        """Record the first vertices, and move the rows that intersect the box to the box.

        Args:
            inside: function that returns which bodies contain each point.
        """
        in_box = ((self.x >= self.box[0]) & (self.x <= self.box[1])).all(-1, keepdim=True)
        self.inside = in_box & inside(self.x)
        self.add_vertices(self.ray)
        entry = torch.where(self.moving, self.enter.clamp(min=0), 0.0)
        self.x += entry[:, None] * self.d
        self.s += entry
        self.inside = inside(self.x)

    def add_vertices(
        self,
        rows: Int[Tensor, "A"],
        surface: Int[Tensor, "A"] | int = 0,
        across: Int[Tensor, "A"] | int = 0,
    ) -> None:
        """Record the present positions of rows as vertices; see `Path` for the numbers."""
        body = self.medium.deciding_body(self.inside[rows])
        self.lines.append(rows, self.x[rows], self.d[rows], self.s[rows], (body, surface, across))

    def apply_interface(
        self,
        rows: Int[Tensor, "A"],
        before: Float[Tensor, "A"],
        after: Float[Tensor, "A"],
        body: Int[Tensor, "A L"],
        normal: Float[Tensor, "A 3"],
    ) -> None:
        """Refract and reflect rows at the next surface.

        Args:
            rows: rows that intersect a surface.
            before, after: distances to points just before and just behind the surface, from which reflected and
                transmitted light continues.
            body: bodies whose surfaces are met at this distance, from 0; -1 for none. The first is recorded.
            normal: unit normal of either orientation.
        """
        inside = self.inside[rows]
        # Number of crossed surfaces of each body; the first column takes the entries without a surface.
        num_crossed = rows.new_zeros(len(rows), inside.shape[1] + 1)
        num_crossed.scatter_add_(1, body + 1, torch.ones_like(body))
        flipped = inside ^ (num_crossed[:, 1:] % 2 == 1)
        number, across = self.medium.deciding_body(inside), self.medium.deciding_body(flipped)
        n_before, n_after = self.indices[number], self.indices[across]
        visible = n_before != n_after
        recorded = visible | (number != across) & (self.absorbs[number] | self.absorbs[across])
        exceeds = visible & (self.num_events[rows] >= self.max_events)
        self.exceeded[rows], self.moving[rows] = exceeds, ~exceeds
        met = _Crossing(before, after, body, normal, flipped, across, n_before, n_after, visible, recorded)
        rows, met = rows[~exceeds], met.select(~exceeds)
        outgoing, reflected = refract(self.d[rows], met.normal, met.n_before, met.n_after)
        reflected &= met.visible
        if self.branching.max_split_events:
            share = reflectance(self.d[rows], met.normal, met.n_before, met.n_after)
            rows, place, reflected = self._split(rows, torch.where(met.visible, share, 0.0), reflected)
            met = met.select(place)
            outgoing, _ = refract(self.d[rows], met.normal, met.n_before, met.n_after, reflected)
        length = torch.where(reflected, met.before, met.after)
        self.inside[rows] = torch.where(reflected[:, None], self.inside[rows], met.flipped)
        self.x[rows] += length[:, None] * self.d[rows]
        self.s[rows] += length
        self.d[rows] = torch.where(met.visible[:, None], outgoing, self.d[rows])
        self.num_events[rows] += met.visible
        vertex = met.select(met.recorded)
        self.add_vertices(rows[met.recorded], vertex.body[:, 0] + 1, vertex.across)

    def _split(
        self, rows: Int[Tensor, "A"], share: Float[Tensor, "A"], reflected: Bool[Tensor, "A"]
    ) -> tuple[Int[Tensor, " split"], Int[Tensor, " split"], Bool[Tensor, " split"]]:
        """Duplicate rows whose light splits; the reflected part becomes the next row.

        Args:
            rows: rows that intersect a surface.
            share: reflectance, 0 where there is nothing to see.
            reflected: whether each row is totally reflected.

        Returns:
            The rows and the duplicates, the place of each in the former `rows`, and whether it is reflected.
        """
        splits, whole = self.branching.decide(self.weight[rows], share, self.num_events[rows])
        followed = splits & (not self.branching.main_only)
        copies = torch.ones_like(self.ray)
        copies[rows] += followed
        source = torch.arange(len(copies), device=rows.device).repeat_interleave(copies)
        parent = torch.arange(len(rows), device=rows.device).repeat_interleave(1 + followed.long())
        second = torch.zeros_like(parent, dtype=torch.bool)
        second[1:] = parent[1:] == parent[:-1]
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[source])
        self.lines.take(source)
        rows = (copies.cumsum(0) - copies)[rows[parent]] + second
        share = share[parent]
        self.weight[rows] *= torch.where(splits[parent], torch.where(second, share, 1 - share), 1.0)
        return rows, parent, (reflected | whole)[parent] | second

    def finish(self, rays: Rays) -> SnellTrace:
        """Append the last vertices, and return the trace in the precision and on the device of the rays."""
        refracted, device = self.lines.counts > 1, rays.origins.device
        self.lines.append_ends(self.far[self.ray], self.box, refracted, self.x, self.d, self.s)
        if not self.branching.max_split_events:
            path = self.lines.path(rays, refracted)
        else:
            ray = self.ray.to(device)
            path = split(self.lines.path(rays[ray], refracted), ray, self.weight.to(rays.origins))
        return SnellTrace(path, self.num_events.to(device), self.exceeded.to(device))
