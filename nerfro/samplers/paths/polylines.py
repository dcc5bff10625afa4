"""Construction of the polylines of many rays at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.types import OpticalRecord, Path, Rays
from nerfro.geometry.interpolation import intersect_box
from nerfro.kernels.tolerances import BEYOND_BOX


def distance_to_end(
    far: Float[Tensor, "P"],
    box: Float[Tensor, "2 3"],
    refracted: Bool[Tensor, "P"],
    positions: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    s: Float[Tensor, "P"],
) -> Float[Tensor, "P"]:
    """Return the distance from the last event of each ray to far; bent rays end outside of the box, if farther."""
    _, leave = intersect_box(box, positions, directions)
    out = leave.clamp(min=0) + BEYOND_BOX * (box[1] - box[0]).min()
    return torch.where(refracted, torch.maximum(far - s, out), far - s)


class SnellTrace(NamedTuple):
    """Result of tracing rays through solids.

    Attributes:
        path: polylines with one vertex for each event, besides near and far. Surfaces of absorbing bodies are vertices
            even if the index does not change there.
        num_events: number of refractions and reflections of each polyline.
        exceeded: whether the polyline met the limit of events, after which it continues straight.
    """

    path: Path
    num_events: Int[Tensor, "P"]
    exceeded: Bool[Tensor, "P"]

    @classmethod
    def without_events(cls, path: Path) -> SnellTrace:
        """Return the trace of paths that meet no sharp surface."""
        none = torch.zeros_like(path.ray)
        return cls(path, none, none.bool())


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


def split(path: Path, ray: Int[Tensor, "P"], weight: Float[Tensor, "P"]) -> Path:
    """Return polylines of rays that split, given the ray of each polyline and its share of the light of the ray."""
    return replace(path, splits=True, ray=ray, throughput=weight[:, None].expand(-1, 3))
