"""Values that pass between components. Lengths are in world units, and shapes use the following axis letters.

| Letter | Axis |
|---|---|
| R | rays |
| P | polylines; P = R if no ray splits |
| S | vertices of a polyline |
| N | samples of a polyline |
| E | boundaries of the intervals of samples, E = N + 1 |
| Q | pixels |
| V | views |
| H, W | rows and columns of an image |
| K | bodies |
| C | channels |

All modules and plugins use these letters for these axes only. Other axes have names, such as `points`, or letters that
are defined where they are used. A name on its own begins with a space, which linters require.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.draws import Draws
from nerfro.core.rays import Rays, in_room

WORLD_ORIGIN = np.zeros(3)


@dataclass(frozen=True)
class OpticalRecord:
    """Bodies and surfaces that the vertices of P polylines meet.

    Attributes:
        body: body of the segment after each vertex (`Bodies.deciding_body`), numbered from 1; 0 in air.
        surface_body: body on whose surface each vertex lies, numbered as `body`; 0 for vertices on no surface, such as
            both ends.
        far_side: body on the other side of the surface, numbered as `body`. Transmitted light enters the body,
            reflected light does not. 0 for vertices on no surface.
        triangle: triangle on which each vertex lies; -1 if the surface has no triangles.
        band: number of the wavelength of the polyline in dispersive media; otherwise 0.
        absorption: absorption coefficients of air and of each body for red, green and blue, per world unit; empty if
            all media are clear.
    """

    body: Int[Tensor, "P S"]
    surface_body: Int[Tensor, "P S"]
    far_side: Int[Tensor, "P S"]
    triangle: Int[Tensor, "P S"]
    band: Int[Tensor, "P"]
    absorption: Float[Tensor, "media 3"]

    @classmethod
    def of_bodies(
        cls, body: Int[Tensor, "P S"], surface_body: Int[Tensor, "P S"], far_side: Int[Tensor, "P S"]
    ) -> OpticalRecord:
        """Create the record of clear bodies at one wavelength, whose surfaces have no triangles.

        The class documents the arguments. The other fields are expanded constants, which take no memory.
        """
        zero = torch.zeros((), dtype=torch.int8, device=body.device)
        absorption = torch.empty(0, 3, device=body.device)
        return cls(body, surface_body, far_side, (zero - 1).expand(body.shape), zero.expand(len(body)), absorption)

    def __getitem__(self, index: slice | Tensor) -> OpticalRecord:
        """Select polylines."""
        return replace(self, **{name: getattr(self, name)[index] for name in _OF_ROWS})


# Fields with a row for each polyline, of `Path` and of its record, and those that have a column for each vertex.
_OF_PATHS = ("positions", "directions", "s", "refracted", "radii", "ray", "throughput", "room")
_OF_ROWS = ("body", "surface_body", "far_side", "triangle", "band")
_OF_VERTICES = ("positions", "directions", "s", "body", "surface_body", "far_side", "triangle")


@dataclass(frozen=True)
class Path:
    """Rays as polylines in arc length.

    The segment between vertices i and i + 1 has the direction `directions[i]`. A straight ray is a path of two
    vertices. Rows with fewer vertices than others repeat their last vertex, including the arc length.

    If light splits at a surface, the ray has several polylines, each complete from the camera on. Rendering sums their
    contributions (`sum_polylines`). `unbranched` creates an ordinary path with one polyline per ray,
    `dataclasses.replace` derives a path from another, `path[rows]` and `select_rays` select rows, and `joined`
    concatenates paths.

    Attributes:
        positions: vertices, world units.
        directions: unit direction of the segment after each vertex; at the last vertex, the exit direction.
        s: arc length from the camera at each vertex, non-decreasing, world units. `s[:, 0]` is near; `s[:, -1]` is far,
            or more if the ray leaves the object later.
        refracted: whether the polyline meets the medium (an index other than 1, or an absorbing body).
        radii: pixel cone radius at unit distance, from the rays.
        ray: ray of each polyline, non-decreasing; every ray has at least one polyline.
        throughput: linear factor of the light of the polyline; the factors of a ray sum to at most 1.
        splits: whether rays may have several polylines. If not, `ray` counts from 0 and `throughput` is 1 everywhere.
        record: bodies and surfaces that the vertices meet; None in media without sharp surfaces.
        room: rotation from the world to the room, see `Rays.room`; None if they are the same.
    """

    positions: Float[Tensor, "P S 3"]
    directions: Float[Tensor, "P S 3"]
    s: Float[Tensor, "P S"]
    refracted: Bool[Tensor, "P"]
    radii: Float[Tensor, "P"]
    ray: Int[Tensor, "P"]
    throughput: Float[Tensor, "P 3"]
    splits: bool = False
    record: OpticalRecord | None = None
    room: Float[Tensor, "P 3 3"] | None = None

    @classmethod
    def unbranched(
        cls,
        positions: Float[Tensor, "R S 3"],
        directions: Float[Tensor, "R S 3"],
        s: Float[Tensor, "R S"],
        refracted: Bool[Tensor, "R"],
        radii: Float[Tensor, "R"],
        record: OpticalRecord | None = None,
    ) -> Path:
        """Create a path of one polyline per ray. The class documents the arguments."""
        ray, throughput = torch.arange(len(s), device=s.device), s.new_ones(()).expand(len(s), 3)
        return cls(positions, directions, s, refracted, radii, ray, throughput, record=record)

    @classmethod
    def joined(cls, paths: Sequence[Path]) -> Path:
        """Concatenate the polylines of paths; the rays of each path follow the rays of the previous path.

        Either all paths have a record, or none.
        """
        num_vertices, num_rays = max([path.s.shape[1] for path in paths]), 0
        columns: dict[str, list[Tensor]] = {name: [] for name in (*_OF_PATHS, *_OF_ROWS)}
        for path in paths:
            missing = num_vertices - path.s.shape[1]
            for part, names in ((path, _OF_PATHS), (path.record, _OF_ROWS)):
                for name in names if part is not None else ():
                    values = getattr(part, name)
                    if values is not None:
                        # Short rows repeat their last vertex.
                        padding = [values[:, -1:]] * missing if name in _OF_VERTICES else []
                        columns[name].append(torch.cat([values, *padding], dim=1) if padding else values)
            columns["ray"][-1] = path.ray + num_rays
            num_rays += path.num_rays
        joined: dict[str, Any] = {name: torch.cat(values) for name, values in columns.items() if values}
        record, records = None, [path.record for path in paths if path.record is not None]
        if records:
            absorption = max([record.absorption for record in records], key=len)
            record = OpticalRecord(absorption=absorption, **{name: joined.pop(name) for name in _OF_ROWS})
        return cls(**joined, splits=any([path.splits for path in paths]), record=record)

    def __repr__(self) -> str:
        polylines, vertices = self.s.shape
        ends = f", s from {self.near.min():.3g} to {self.far.max():.3g}" if polylines else ""
        refracted = int(self.refracted.sum())
        return f"Path({self.num_rays} rays, {polylines} polylines of {vertices} vertices, {refracted} refracted{ends})"

    @property
    def absorbs(self) -> bool:
        """Whether the path may cross absorbing bodies."""
        return self.record is not None and len(self.record.absorption) > 0

    @property
    def num_rays(self) -> int:
        """Number of rays, equal to the number of polylines if no ray splits."""
        return int(self.ray[-1]) + 1 if self.splits and len(self.ray) else len(self.ray)

    def sum_polylines(self, values: Float[Tensor, "P *C"]) -> Float[Tensor, "R *C"]:
        """Sum the values of the polylines of each ray, weighted by their throughput."""
        if not self.splits:
            return values
        values = values * (self.throughput if values.ndim > 1 else self.throughput.mean(-1))
        return values.new_zeros(self.num_rays, *values.shape[1:]).index_add(0, self.ray, values)

    def broadcast_to_polylines(self, values: Shaped[Tensor, "R *C"]) -> Shaped[Tensor, "P *C"]:
        """Broadcast a value per ray to the polylines of the ray."""
        return values[self.ray] if self.splits else values

    def main_polyline(self, values: Shaped[Tensor, "P *C"]) -> Shaped[Tensor, "R *C"]:
        """Select the value of the main polyline of each ray, which is the first."""
        if not self.splits:
            return values
        return values[torch.searchsorted(self.ray, torch.arange(self.num_rays, device=self.ray.device))]

    def transmitted(self, s: Float[Tensor, "P N"]) -> Float[Tensor, "P N 3"]:
        """Compute the transmittance of absorbing bodies between the camera and arc lengths `s` (Beer-Lambert law)."""
        assert self.record is not None
        absorption, body = self.record.absorption, self.record.body
        vertex, lengths = self._vertex_before(s), self.s.diff(dim=1)
        since = s - self.s.gather(1, vertex)
        depth = s.new_zeros(*s.shape, 3)
        for number in range(1, len(absorption)):
            within = (body == number).to(s)
            before = torch.nn.functional.pad((within[:, :-1] * lengths).cumsum(1), (1, 0))
            length = before.gather(1, vertex) + within.gather(1, vertex) * since
            depth = depth + length[..., None] * absorption[number]
        return torch.exp(-depth)

    def whole_transmittance(self) -> Float[Tensor, "P 3"]:
        """Compute the transmittance of absorbing bodies along each whole polyline; 1 if all bodies are clear."""
        return self.transmitted(self.far[:, None])[:, 0] if self.absorbs else torch.ones_like(self.throughput)

    def exits(self, directions: Float[Tensor, "P 3"] | None = None) -> Exits:
        """Return the last segment of each polyline, along which background radiance arrives, in axes of the room."""
        turns = (self.directions[:, 1:] != self.directions[:, :-1]).any(-1)
        last = (turns * torch.arange(1, self.s.shape[1], device=self.s.device)).amax(-1)
        start = self.positions.gather(1, last[:, None, None].expand(-1, 1, 3))[:, 0]
        directions = self.exit_directions if directions is None else directions
        return Exits(in_room(directions, self.room), start if self.room is None else None, self.radii)

    def in_room_of(self, rays: Rays) -> Path:
        """Return the path with the rotations to the room of its rays."""
        return self if rays.room is None else replace(self, room=self.broadcast_to_polylines(rays.room))

    @property
    def near(self) -> Float[Tensor, "P"]:
        return self.s[:, 0]

    @property
    def far(self) -> Float[Tensor, "P"]:
        return self.s[:, -1]

    @property
    def end_positions(self) -> Float[Tensor, "P 3"]:
        """End of each polyline, behind the last event."""
        return self.positions[:, -1]

    @property
    def exit_directions(self) -> Float[Tensor, "P 3"]:
        """Unit direction in which each polyline leaves the bounded volume."""
        return self.directions[:, -1]

    def __getitem__(self, index: slice | Tensor) -> Path:
        """Select polylines; each becomes the only polyline of a new ray."""
        columns = {name: getattr(self, name) for name in _OF_PATHS}
        rows = {name: column[index] for name, column in columns.items() if column is not None}
        rows["ray"] = torch.arange(len(rows["s"]), device=self.s.device)
        return Path(**rows, splits=self.splits, record=None if self.record is None else self.record[index])

    def select_rays(self, rows: Int[Tensor, " selected"]) -> Path:
        """Select rays with all their polylines."""
        if not self.splits:
            return self[rows]
        counts = torch.bincount(self.ray, minlength=self.num_rays)
        first, num = (counts.cumsum(0) - counts)[rows], counts[rows]
        ray = torch.arange(len(rows), device=rows.device).repeat_interleave(num)
        branch = torch.arange(len(ray), device=rows.device) - (num.cumsum(0) - num)[ray]
        return replace(self[first[ray] + branch], ray=ray)

    def span(self, box: Float[Tensor, "2 3"]) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """Return the arc lengths of the first entry into a box and of the last exit.

        Rows that miss the box have an empty span at far.
        """
        starts, directions = self.positions[:, :-1], self.directions[:, :-1]
        lengths = self.s[:, 1:] - self.s[:, :-1]
        # Slab test; a direction parallel to a slab divides by zero, and infinities compare correctly.
        to_low, to_high = (box[0] - starts) / directions, (box[1] - starts) / directions
        enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf).amax(-1).clamp(min=0)
        leave = torch.minimum(torch.maximum(to_low, to_high).nan_to_num(torch.inf).amin(-1), lengths)
        meets = enter < leave
        far = self.far[:, None]
        first = torch.where(meets, self.s[:, :-1] + enter, far).amin(-1)
        last = torch.where(meets, self.s[:, :-1] + leave, -torch.inf).amax(-1)
        return first, torch.maximum(first, last)

    def at(self, s: Float[Tensor, "P N"]) -> tuple[Float[Tensor, "P N 3"], Float[Tensor, "P N 3"]]:
        """Return positions and directions at arc lengths `s`, from the nearest previous vertex (paper, section 2).

        As in the authors' code, the previous vertex is strictly before `s`, so a sample on a vertex has the direction
        of the segment before the vertex.
        """
        vertex = self._vertex_before(s)
        index = vertex[..., None].expand(-1, -1, 3)
        directions = self.directions.gather(1, index)
        positions = self.positions.gather(1, index) + directions * (s - self.s.gather(1, vertex))[..., None]
        return positions, directions

    def _vertex_before(self, s: Float[Tensor, "P N"]) -> Int[Tensor, "P N"]:
        # searchsorted needs contiguous rows; `contiguous` is free for contiguous tensors.
        vertex = torch.searchsorted(self.s.detach().contiguous(), s.detach().contiguous(), side="left") - 1
        return vertex.clamp(min=0)


@dataclass(frozen=True)
class Exits:
    """Segments along which background radiance arrives from far away; leading axes may have any shape.

    Attributes:
        directions: unit directions away from the volume.
        positions: starts of the segments: the last event of the path, or the point at near. None for the centre of the
            scene, and on a turntable, where the position in the room is unknown.
        radii: radius of the pixel cone at unit distance along the segment; 0 if unknown.
    """

    directions: Float[Tensor, "*batch 3"]
    positions: Float[Tensor, "*batch 3"] | None = None
    radii: Float[Tensor, "*batch"] | float = 0.0

    @classmethod
    def unbent(cls, rays: Rays) -> Exits:
        """Return the segments of straight rays."""
        starts = None if rays.room is not None else rays.origins + rays.near[:, None] * rays.directions
        return cls(in_room(rays.directions, rays.room), starts, rays.radii)


@dataclass(frozen=True)
class Samples:
    """Samples of the radiance field along a path; sample i represents the interval from edges[i] to edges[i + 1].

    Point samples (NeRF) lie at the start of their interval, cone samples (mip-NeRF) in the middle. `s` is metric arc
    length, which mip-NeRF 360 writes t; `contracted_edges` plays the role of its normalized distance s.

    Attributes:
        positions: positions at which the field is evaluated.
        directions: unit directions of the path at the samples.
        s: arc lengths from the camera.
        edges: bounds of the intervals in arc length.
        radii: pixel cone radius at unit distance.
        occupied: samples at which the field may be dense; others need not be evaluated. None for all.
        lengths: world lengths by which densities are multiplied, if space is contracted within the intervals; None for
            the lengths of the intervals.
        contracted_edges: bounds of the intervals in contracted length; None without contraction.
    """

    positions: Float[Tensor, "P N 3"]
    directions: Float[Tensor, "P N 3"]
    s: Float[Tensor, "P N"]
    edges: Float[Tensor, "P N+1"]
    radii: Float[Tensor, "P"]
    occupied: Bool[Tensor, "P N"] | None = None
    lengths: Float[Tensor, "P N"] | None = None
    contracted_edges: Float[Tensor, "P N+1"] | None = None

    @classmethod
    def along(cls, path: Path, s: Float[Tensor, "P N"], edges: Float[Tensor, "P N+1"]) -> Samples:
        """Create samples at arc lengths of a path; positions and directions have the gradients of the path."""
        s, edges = s.detach(), edges.detach()
        positions, directions = path.at(s)
        return cls(positions, directions, s, edges, path.radii)

    def on(self, path: Path) -> Samples:
        """Return the samples with the positions and directions of a path, and their gradients."""
        positions, directions = path.at(self.s)
        return replace(self, positions=positions, directions=directions)

    @property
    def deltas(self) -> Float[Tensor, "P N"]:
        """Length by which the density of each sample is multiplied, in world units."""
        return self.lengths if self.lengths is not None else self.edges[:, 1:] - self.edges[:, :-1]


@dataclass(frozen=True)
class FieldValues:
    """Result of a field: density (per world unit, not negative) and radiance in the colour space of the model."""

    density: Float[Tensor, "P N"]
    radiance: Float[Tensor, "P N 3"]


@dataclass(frozen=True)
class Rendering:
    """One sampling level of rendered rays (paper, Eqn. 5).

    Attributes:
        radiance: radiance of each ray in the colour space of the scene, including the background; the sum over all
            polylines of the ray.
        weights: contribution of each sample to its polyline.
        transmittance: transmittance at the end of each polyline, T_{N+1}.
        background_radiance: background radiance in the exit direction, C'(d_N), after absorption by the medium.
        samples: samples of the level.
        path: path of the samples.
        gain: brightness of the photograph relative to the scene, already applied to `radiance` and
            `background_radiance`; None for no gain.
    """

    radiance: Float[Tensor, "R 3"]
    weights: Float[Tensor, "P N"]
    transmittance: Float[Tensor, "P"]
    background_radiance: Float[Tensor, "P 3"]
    samples: Samples
    path: Path
    gain: Float[Tensor, "P 3"] | None = None

    def exposed(self, gain: Float[Tensor, "R 3"]) -> Rendering:
        """Multiply linear radiance by the gain of the photograph of each ray."""
        of_path = self.path.broadcast_to_polylines(gain)
        radiance, background_radiance = self.radiance * gain, self.background_radiance * of_path
        return replace(self, radiance=radiance, background_radiance=background_radiance, gain=of_path)

    @property
    def background_fraction(self) -> Float[Tensor, "P 3"]:
        """Fraction of the background radiance that reaches the camera along each polyline."""
        fraction = self.transmittance[:, None] * self.path.throughput
        return fraction * self.path.whole_transmittance() if self.path.absorbs else fraction

    @property
    def opacity(self) -> Float[Tensor, "R"]:
        return self.path.sum_polylines(self.weights.sum(-1))

    @property
    def depth(self) -> Float[Tensor, "R"]:
        """Expected arc length: intervals count at their centres, in contracted space at their samples.

        The end of the main polyline if the opacity is zero.
        """
        weight = self.opacity
        edges = self.samples.edges
        centres = self.samples.s if self.samples.lengths is not None else 0.5 * (edges[:, 1:] + edges[:, :-1])
        depth = self.path.sum_polylines((self.weights * centres).sum(-1)) / weight.clamp(min=1e-6)
        return torch.where(weight > 1e-6, depth, self.path.main_polyline(self.path.far))

    @property
    def exit_directions(self) -> Float[Tensor, "R 3"]:
        """Unit exit direction of the main polyline of each ray."""
        return self.path.main_polyline(self.path.exit_directions)


@dataclass(frozen=True)
class Pixels:
    """Q training pixels of one step.

    Attributes:
        number: number of each pixel in the data set, view * H * W + row * W + column.
        view: number of the training view of each pixel.
        rgb: colour of each pixel in its photograph, sRGB as in `Views.images`.
        draws: random numbers of the step, with an index for each pixel.
        cameras: all training cameras.
        window: all training cameras, cropped to the window of the first steps (`batches.precrop_steps`).
        photographed: function that returns the colours of pixels by number.
        maps: further values of each pixel by name, see `Batch`.
    """

    number: Int[Tensor, "Q"]
    view: Int[Tensor, "Q"]
    rgb: Float[Tensor, "Q 3"]
    draws: Draws
    cameras: Cameras
    window: Cameras
    photographed: Callable[[Int[Tensor, "P"]], Float[Tensor, "P 3"]]
    maps: Mapping[str, Float[Tensor, "Q _"]] = field(default_factory=dict)


@dataclass(frozen=True)
class Batch:
    """Training pixels and the rays through them: R rays through Q pixels, at least one through each.

    Losses compare pixels, not rays: losses average over the rays of each pixel with `per_pixel`, then over pixels with
    `mean()`. With several processes, the mean is correct because each process has the same number of pixels.

    Attributes:
        rays: rays of the estimated cameras, with gradients if the cameras learn.
        ray_pixel: pixel of each ray, as an index from 0 to Q - 1.
        pixel_number: number of each pixel in the data set, view * H * W + row * W + column.
        view: number of the training view of each pixel.
        rgb: colour of each pixel in its photograph, sRGB as in `Views.images`.
        teaches_background: pixels from which the background learns; diverging rays of other pixels would cause noise.
        cameras: all training cameras, cropped to the window of the first steps (`batches.precrop_steps`); for losses
            that need further directions.
        draws: random numbers of the step, with an index for each ray.
        path: paths of the rays without gradients; None before tracing.
        samples: samples of the first sampling level, if they were chosen with the paths.
        maps: further values of each pixel by name, from `Views.maps`, such as `depth`.
    """

    rays: Rays
    ray_pixel: Int[Tensor, "R"]
    pixel_number: Int[Tensor, "Q"]
    view: Int[Tensor, "Q"]
    rgb: Float[Tensor, "Q 3"]
    teaches_background: Bool[Tensor, "Q"]
    cameras: Cameras
    draws: Draws
    path: Path | None = None
    samples: Samples | None = None
    maps: Mapping[str, Float[Tensor, "Q _"]] = field(default_factory=dict)

    @property
    def ray_view(self) -> Int[Tensor, "R"]:
        """Number of the training view of each ray."""
        return self.view[self.ray_pixel]

    def per_pixel(self, values: Float[Tensor, "R *C"]) -> Float[Tensor, "Q *C"]:
        """Average the values of each pixel's rays."""
        return mean_per_pixel(values, self.ray_pixel, len(self.rgb))


def mean_per_pixel(
    values: Float[Tensor, "R *C"], ray_pixel: Int[Tensor, "R"], num_pixels: int
) -> Float[Tensor, "Q *C"]:
    """Average the values of the rays of each pixel.

    Args:
        values: values of the rays.
        ray_pixel: index of the pixel of each ray; each pixel has a ray, and single rays are in the order of the pixels.
        num_pixels: number of pixels.
    """
    if len(ray_pixel) == num_pixels:  # one ray through each pixel, in their order
        return values
    total = values.new_zeros(num_pixels, *values.shape[1:]).index_add(0, ray_pixel, values)
    num_rays = values.new_zeros(num_pixels).index_add(0, ray_pixel, torch.ones_like(ray_pixel, dtype=values.dtype))
    return total / num_rays.view(-1, *[1] * (values.ndim - 1))
