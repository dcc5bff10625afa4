"""Polylines of rays that are traced through solids: which branches are followed, and where polylines end."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.types import Path
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


def split(path: Path, ray: Int[Tensor, "P"], weight: Float[Tensor, "P"]) -> Path:
    """Return polylines of rays that split, given the ray of each polyline and its share of the light of the ray."""
    return replace(path, splits=True, ray=ray, throughput=weight[:, None].expand(-1, 3))
