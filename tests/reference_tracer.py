"""Reference implementation of the tracer of bodies in PyTorch, for signed distances in closed form, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.core.types import OpticalRecord, Path, Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.kernels.tolerances import MIN_SEARCH_STEP
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths import snell
from nerfro.samplers.paths.branching import ONE_PATH, Branching
from nerfro.samplers.paths.polylines import SnellTrace, distance_to_end, split
from nerfro.samplers.paths.replay import indices_of
from nerfro.samplers.paths.snell_law import reflectance, refract

_ROOT_ITERATIONS = 60
# Attributes of `Wavefront` with one row for each polyline.
_COLUMNS = ("x", "d", "s", "inside", "moving", "ray", "weight", "num_events", "exceeded")


class PolylineBuilder:
    """Paths under construction: rows of any number of vertices."""

    def __init__(self, num_rays: int, like: Float[Tensor, "..."]) -> None:
        self._vertices = like.new_zeros(num_rays, 4, 7)
        self._crossed = torch.zeros(num_rays, 4, 3, dtype=torch.int8, device=like.device)
        self.counts = torch.zeros(num_rays, dtype=torch.long, device=like.device)

    def append(
        self,
        rows: Int[Tensor, "A"],
        positions: Float[Tensor, "A 3"],
        directions: Float[Tensor, "A 3"],
        s: Float[Tensor, "A"],
        crossed: Sequence[Int[Tensor, "A"] | int] = (0, 0, 0),
    ) -> None:
        """Add one vertex to each of some rows.

        Args:
            rows: rows, each at most once.
            positions, directions, s: the vertices.
            crossed: body, surface and far side of each vertex, see `OpticalRecord`; by default those in air.
        """
        if len(rows) and int(self.counts[rows].max()) == self._vertices.shape[1]:
            self._vertices = torch.cat([self._vertices, torch.zeros_like(self._vertices)], 1)
            self._crossed = torch.cat([self._crossed, torch.zeros_like(self._crossed)], 1)
        self._vertices[rows, self.counts[rows]] = torch.cat([positions, directions, s[:, None]], -1)
        for i, numbers in enumerate(crossed):
            self._crossed[rows, self.counts[rows], i] = torch.as_tensor(numbers, dtype=torch.int8)
        self.counts[rows] += 1

    def take(self, rows: Int[Tensor, "T"]) -> None:
        """Replace all rows by a selection, in which rows may occur several times."""
        self._vertices, self._crossed, self.counts = self._vertices[rows], self._crossed[rows], self.counts[rows]

    def append_ends(
        self,
        far: Float[Tensor, "P"],
        box: Float[Tensor, "2 3"],
        refracted: Bool[Tensor, "P"],
        positions: Float[Tensor, "P 3"],
        directions: Float[Tensor, "P 3"],
        s: Float[Tensor, "P"],
    ) -> None:
        """Add the last vertex of every row."""
        ahead = distance_to_end(far, box, refracted, positions, directions, s)
        rows = torch.arange(len(s), device=s.device)
        self.append(rows, positions + ahead[:, None] * directions, directions, s + ahead)

    def path(self, rays: Rays, refracted: Bool[Tensor, "P"]) -> Path:
        """Return the finished paths in the precision and on the device of the rays; short rows repeat the last vertex.

        Args:
            rays: ray of each row.
            refracted: whether each row met the medium.
        """
        like = rays.origins
        capacity = int(self.counts.max()) if len(self.counts) else 2
        index = torch.arange(capacity, device=self.counts.device).minimum(self.counts[:, None] - 1)[..., None]
        vertices = self._vertices.take_along_dim(index, 1).to(like)
        crossed = self._crossed.take_along_dim(index, 1).to(like.device)
        record = OpticalRecord.of_bodies(*crossed.unbind(-1))
        return Path.unbranched(
            vertices[..., :3], vertices[..., 3:6], vertices[..., 6], refracted.to(like.device), rays.radii, record
        )


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


class Snell(snell.Snell):
    """The sampler of nerfro, which traces bodies without grids by the reference implementation."""

    def tracers(self, medium: Medium) -> list[snell.Tracer]:
        """Return the tracers of the base class, or reference tracers for a medium in closed form."""
        tracers = super().tracers(medium)
        if medium.bodies is None or len(medium.bodies.grids):
            return tracers
        return [ReferenceTracer(tracer.medium) if hasattr(tracer, "medium") else tracer for tracer in tracers]


class ReferenceTracer(snell.Tracer):
    """Trace zero levels of any signed distances by operators of PyTorch."""

    def trace(self, rays: Rays, max_events: int, branching: Branching) -> SnellTrace:
        """Trace rays without gradients, and count events."""
        return trace_interfaces(rays, self.medium, max_events, branching)


def trace_interfaces(rays: Rays, medium: Bodies, max_events: int, branching: Branching = ONE_PATH) -> SnellTrace:
    """Trace rays from surface to surface of any solid; the reference implementation of the compiled kernel.

    Sphere tracing finds the surfaces, because a step of the signed distance cannot miss one. A change of sign ends the
    search, and bisection shrinks the bracket around the surface.
    """
    box = medium.box
    front = Wavefront(rays, medium, box, max_events, branching)
    front.begin(lambda x: medium.signed_distances(x)[0] < 0)
    min_step = MIN_SEARCH_STEP * float((box[1] - box[0]).min())
    while len(rows := front.moving.nonzero()[:, 0]):
        x, d, inside = front.x[rows], front.d[rows], front.inside[rows]
        before, after, crossed = _search(medium, x, d, inside, intersect_box(box, x, d)[1], min_step)
        front.moving[rows] = crossed
        rows, x, d, inside, before, after = (values[crossed] for values in (rows, x, d, inside, before, after))
        before, after, body = _first_crossing(medium, x, d, inside, before, after)
        after, bodies = _closed_gaps(medium, x, d, inside, after, body, min_step)
        _, normals = medium.signed_distances(x + after[:, None] * d)
        normal = functional.normalize(normals.take_along_dim(body[:, None, None], 1)[:, 0], dim=-1)
        front.apply_interface(rows, before, after, bodies, normal)
    return front.finish(rays)


def _search(
    medium: Bodies, x: Tensor, d: Tensor, inside: Tensor, limit: Tensor, min_step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Trace spheres up to `limit`; returns start and end of the last step, and whether it crosses a surface."""
    before, after = torch.zeros_like(limit), torch.zeros_like(limit)
    crossed = torch.zeros_like(limit, dtype=torch.bool)
    going = torch.arange(len(limit), device=limit.device)
    while len(going):
        phi, _ = medium.signed_distances(x[going] + after[going, None] * d[going])
        crossed[going] = ((phi < 0) != inside[going]).any(-1)
        more = ~crossed[going] & (after[going] < limit[going])
        going, phi = going[more], phi[more]
        before[going] = after[going]
        step = phi.abs().amin(-1).clamp(min=min_step)
        after[going] = torch.minimum(after[going] + step, limit[going])
    return before, after, crossed


def _first_crossing(
    medium: Bodies, x: Tensor, d: Tensor, inside: Tensor, before: Tensor, after: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Bisect each bracket around the first change of sign; returns the bracket and the body whose sign changes."""
    for _ in range(_ROOT_ITERATIONS):
        middle = 0.5 * (before + after)
        phi, _ = medium.signed_distances(x + middle[:, None] * d)
        changed = ((phi < 0) != inside).any(-1)
        after = torch.where(changed, middle, after)
        before = torch.where(changed, before, middle)
    phi, _ = medium.signed_distances(x + after[:, None] * d)
    changed = (phi < 0) != inside
    return before, after, changed.long().argmax(-1)


def _closed_gaps(
    medium: Bodies, x: Tensor, d: Tensor, inside: Tensor, after: Tensor, body: Tensor, min_step: float
) -> tuple[Tensor, Tensor]:
    """Close gaps of air between two bodies that are thinner than the shortest step of the search.

    Returns:
        Distance behind all surfaces that are met, and the bodies with these surfaces [A, L], -1 for none.
    """
    if inside.shape[1] == 1:
        return after, body[:, None]
    flipped = inside ^ functional.one_hot(body, inside.shape[1]).bool()
    leaves = (medium.deciding_body(inside) > 0) & (medium.deciding_body(flipped) == 0)
    phi, _ = medium.signed_distances(x + (after + min_step)[:, None] * d)
    behind = leaves[:, None] & ((phi < 0) != flipped)
    others = torch.where(behind, torch.arange(inside.shape[1], device=x.device), -1)
    return torch.where(behind.any(1), after + min_step, after), torch.cat([body[:, None], others], 1)
