"""Growing polylines of many rays at once."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.geometry.interpolation import intersect_box
from nerfro.kernels.tolerances import BEYOND_BOX
from nerfro.types import Path, Rays


def distance_to_end(
    far: Float[Tensor, "R"],
    box: Float[Tensor, "2 3"],
    refracted: Bool[Tensor, "R"],
    positions: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    s: Float[Tensor, "R"],
) -> Float[Tensor, "R"]:
    """From the last event of rays to their end: at far, but when bent not before they are out of the box."""
    _, leave = intersect_box(box, positions, directions)
    out = leave.clamp(min=0) + BEYOND_BOX * (box[1] - box[0]).min()
    return torch.where(refracted, torch.maximum(far - s, out), far - s)


class Polylines:
    """Paths under construction: rows of vertices, each row as long as it needs to be."""

    def __init__(self, num_rays: int, like: Float[Tensor, "..."]) -> None:
        self._vertices = like.new_zeros(num_rays, 4, 7)
        self._bodies = torch.zeros(num_rays, 4, dtype=torch.int8, device=like.device)
        self.counts = torch.zeros(num_rays, dtype=torch.long, device=like.device)

    def append(
        self,
        rows: Int[Tensor, "A"],
        positions: Float[Tensor, "A 3"],
        directions: Float[Tensor, "A 3"],
        s: Float[Tensor, "A"],
        bodies: Int[Tensor, "A"] | int = 0,
    ) -> None:
        """Add one vertex to each of the given rows; `bodies` are those in which it is left."""
        if len(rows) and int(self.counts[rows].max()) == self._vertices.shape[1]:
            self._vertices = torch.cat([self._vertices, torch.zeros_like(self._vertices)], 1)
            self._bodies = torch.cat([self._bodies, torch.zeros_like(self._bodies)], 1)
        self._vertices[rows, self.counts[rows]] = torch.cat([positions, directions, s[:, None]], -1)
        self._bodies[rows, self.counts[rows]] = bodies.to(torch.int8) if isinstance(bodies, Tensor) else bodies
        self.counts[rows] += 1

    def take(self, rows: Int[Tensor, "T"]) -> None:
        """Go on with these rows in the place of all, some more than once."""
        self._vertices, self._bodies, self.counts = self._vertices[rows], self._bodies[rows], self.counts[rows]

    def append_ends(
        self,
        far: Float[Tensor, "R"],
        box: Float[Tensor, "2 3"],
        refracted: Bool[Tensor, "R"],
        positions: Float[Tensor, "R 3"],
        directions: Float[Tensor, "R 3"],
        s: Float[Tensor, "R"],
    ) -> None:
        """Add the last vertex of every row."""
        ahead = distance_to_end(far, box, refracted, positions, directions, s)
        rows = torch.arange(len(s), device=s.device)
        self.append(rows, positions + ahead[:, None] * directions, directions, s + ahead)

    def path(
        self,
        rays: Rays,
        refracted: Bool[Tensor, "R"],
        ray: Int[Tensor, "R"] | None = None,
        weight: Float[Tensor, "R"] | None = None,
    ) -> Path:
        """The finished paths; shorter rows repeat their last vertex.

        Where rays split, `ray` and `weight` are the ray of each row and its share.
        """
        capacity = int(self.counts.max()) if len(self.counts) else 2
        index = torch.arange(capacity, device=self.counts.device).minimum(self.counts[:, None] - 1)
        vertices = self._vertices.gather(1, index[..., None].expand(-1, -1, 7))
        directions = vertices[..., 3:6]
        bodies = self._bodies.gather(1, index)
        radii = rays.radii if ray is None else rays.radii[ray]
        throughput = None if weight is None else weight.to(directions)[:, None].expand(-1, 3)
        return Path(
            vertices[..., :3], directions, vertices[..., 6], directions[:, -1], refracted, radii,
            ray, throughput, bodies,  # type: ignore[arg-type]
        )  # fmt: skip
