"""The values that pass between the parts. Shapes use the axis letters below, lengths are in world units.

R rays, S path vertices, N samples, V views, H and W pixels, L sampling levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.light import to_linear, to_srgb
from nerfro.rays import Rays

__all__ = ["Batch", "Path", "Radiance", "Rays", "Rendering", "Samples"]


@dataclass(frozen=True)
class Path:
    """Rays as polylines in arc length: vertex i is left along directions[i] until s[i + 1].

    A straight ray is a path of two vertices. Rows with fewer vertices than others repeat their last one (s and all).

    Attributes:
        positions: vertices.
        directions: unit direction in which each vertex is left.
        s: arc length from the camera at each vertex, non-decreasing. s[:, 0] is near; s[:, -1] is far, or more where
            the object is left later.
        exit_directions: unit direction in which the ray leaves the bounded volume.
        refracted: whether the ray met the medium (n not 1) at all.
        radii: pixel cone radius at unit distance, carried along from the rays.
    """

    positions: Float[Tensor, "R S 3"]
    directions: Float[Tensor, "R S 3"]
    s: Float[Tensor, "R S"]
    exit_directions: Float[Tensor, "R 3"]
    refracted: Bool[Tensor, "R"]
    radii: Float[Tensor, "R"]

    @property
    def near(self) -> Float[Tensor, "R"]:
        return self.s[:, 0]

    @property
    def far(self) -> Float[Tensor, "R"]:
        return self.s[:, -1]

    @property
    def exit_positions(self) -> Float[Tensor, "R 3"]:
        return self.positions[:, -1]

    def __getitem__(self, index: slice | Tensor) -> Path:
        fields = ("positions", "directions", "s", "exit_directions", "refracted", "radii")
        return Path(*(getattr(self, name)[index] for name in fields))

    def followed_by(self, other: Path) -> Path:
        """These paths and after them those of another."""
        num_vertices = max(self.s.shape[1], other.s.shape[1])

        def longer(vertices: Tensor) -> Tensor:
            missing = num_vertices - vertices.shape[1]
            return torch.cat([vertices, vertices[:, -1:].expand(-1, missing, *vertices.shape[2:])], dim=1)

        return Path(
            *(
                torch.cat([longer(getattr(part, name)) for part in (self, other)])
                for name in ("positions", "directions", "s")
            ),
            *(
                torch.cat([getattr(part, name) for part in (self, other)])
                for name in ("exit_directions", "refracted", "radii")
            ),
        )

    def span(self, box: Float[Tensor, "2 3"]) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Arc lengths between which the path runs inside a box, from its first entry to its last exit.

        Rows that never meet the box have an empty span at far.
        """
        starts, directions = self.positions[:, :-1], self.directions[:, :-1]
        lengths = self.s[:, 1:] - self.s[:, :-1]
        # Slab test; a direction parallel to a slab divides by zero, and the infinities compare as they should.
        to_low, to_high = (box[0] - starts) / directions, (box[1] - starts) / directions
        enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf).amax(-1).clamp(min=0)
        leave = torch.minimum(torch.maximum(to_low, to_high).nan_to_num(torch.inf).amin(-1), lengths)
        meets = enter < leave
        far = self.far[:, None]
        first = torch.where(meets, self.s[:, :-1] + enter, far).amin(-1)
        last = torch.where(meets, self.s[:, :-1] + leave, -torch.inf).amax(-1)
        return first, torch.maximum(first, last)

    def at(self, s: Float[Tensor, "R N"]) -> tuple[Float[Tensor, "R N 3"], Float[Tensor, "R N 3"]]:
        """Positions and directions at arc lengths `s` (paper, section 2: the nearest former vertex, floor of t).

        The vertex before `s` is the last one strictly before it, as in the authors' code, so a sample that lies on a
        vertex has the direction of the segment that leads to it.
        """
        # searchsorted needs contiguous rows of its own; both calls are free for tensors that already are.
        vertex = torch.searchsorted(self.s.contiguous(), s.contiguous(), side="left") - 1
        vertex = vertex.clamp(min=0)
        index = vertex[..., None].expand(-1, -1, 3)
        directions = self.directions.gather(1, index)
        positions = self.positions.gather(1, index) + directions * (s - self.s.gather(1, vertex))[..., None]
        return positions, directions


@dataclass(frozen=True)
class Samples:
    """Samples of the radiance field along a path; sample i stands for the interval from edges[i] to edges[i + 1].

    Point samples (NeRF) lie at the start of their interval, cone samples (mip-NeRF) in its middle.

    Attributes:
        positions: where the field is asked.
        directions: unit direction of the path there.
        s: arc length from the camera.
        edges: interval bounds in arc length.
        radii: pixel cone radius at unit distance.
    """

    positions: Float[Tensor, "R N 3"]
    directions: Float[Tensor, "R N 3"]
    s: Float[Tensor, "R N"]
    edges: Float[Tensor, "R N+1"]
    radii: Float[Tensor, "R"]

    @property
    def deltas(self) -> Float[Tensor, "R N"]:
        return self.edges[:, 1:] - self.edges[:, :-1]


@dataclass(frozen=True)
class Radiance:
    """What a field returns: volume density (per world unit, non-negative) and colour (sRGB)."""

    density: Float[Tensor, "R N"]
    rgb: Float[Tensor, "R N 3"]


@dataclass(frozen=True)
class Rendering:
    """One sampling level of rendered rays (paper, Eqn. volrendBd).

    Attributes:
        rgb: pixel colour, boundary term included.
        weights: contribution of each sample.
        transmittance: what is left at the end of the path, T_{N+1}.
        boundary_rgb: colour of the boundary in the leaving direction, C'(d_N).
        samples: the samples that were rendered.
        path: the path they lie on.
    """

    rgb: Float[Tensor, "R 3"]
    weights: Float[Tensor, "R N"]
    transmittance: Float[Tensor, "R"]
    boundary_rgb: Float[Tensor, "R 3"]
    samples: Samples
    path: Path

    @property
    def opacity(self) -> Float[Tensor, "R"]:
        return self.weights.sum(-1)

    @property
    def depth(self) -> Float[Tensor, "R"]:
        """Expected arc length of the samples that were hit; far where nothing was."""
        weight = self.weights.sum(-1)
        centres = 0.5 * (self.samples.edges[:, 1:] + self.samples.edges[:, :-1])
        depth = (self.weights * centres).sum(-1) / weight.clamp(min=1e-6)
        return torch.where(weight > 1e-6, depth, self.path.far)


@dataclass(frozen=True)
class Batch:
    """Training pixels: first those that have one ray, then those that are divided, all rays of each together.

    Attributes:
        rays: of the pixels.
        rgb: colour of the pixel that each ray belongs to (sRGB in [0, 1]).
        index: identity of each training ray: `view * H * W + row * W + column`; of divided pixels the ray's number in
            their `PixelParts`.
        cameras: all training cameras, for losses that ask for further directions.
        num_whole: number of pixels that have one ray; all by default.
        rays_per_pixel: of the divided ones.
        rows: which rows of the whole batch these are, where several processes share it.
        num_rows: of the whole batch.
    """

    rays: Rays
    rgb: Float[Tensor, "R 3"]
    index: Int[Tensor, "R"]
    cameras: Cameras
    num_whole: int | None = None
    rays_per_pixel: int = 1
    rows: Int[Tensor, "R"] | None = None
    num_rows: int | None = None

    def pixel_colours(self, rgb: Float[Tensor, "R 3"]) -> Float[Tensor, "P 3"]:
        """Colours of pixels from those of their rays: means of linear radiance, in sRGB."""
        if self.num_whole is None:
            return rgb
        divided = to_linear(rgb[self.num_whole :]).view(-1, self.rays_per_pixel, 3)
        return torch.cat([rgb[: self.num_whole], to_srgb(divided.mean(1))])
