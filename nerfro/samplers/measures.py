"""Measures of length for even sampling of a polyline: arc length within a box, and contracted length."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.geometry.contraction import FAR, contracted_length, world_length
from nerfro.types import Path


@dataclass(frozen=True)
class LengthInBox:
    """Arc length from a path's first entry into a box to its last exit.

    Attributes:
        first: arc length of the first entry.
        total: arc length from there to the last exit.
    """

    first: Float[Tensor, "P"]
    total: Float[Tensor, "P"]

    @classmethod
    def of(cls, path: Path, box: Float[Tensor, "2 3"]) -> LengthInBox:
        first, last = path.span(box)
        return cls(first, last - first)

    def arc_length(self, length: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
        """Convert lengths from 0 to `total` to arc lengths."""
        return self.first[:, None] + length


@dataclass(frozen=True)
class ContractedLength:
    """Length of a polyline in contracted space, from `near` to practical infinity.

    If necessary, the first segment is extended backwards, and the last one forwards, beyond the ends of the path.

    Attributes:
        cumulative: contracted length at the start of each segment, and in total.
        start_length: signed contracted length from the segment's closest approach to its start.
        closest: arc length of the segment's closest approach to the centre.
        impact: distance of the closest approach from the centre (impact parameter).
        radius: radius of the ball beyond which space is contracted.
    """

    cumulative: Float[Tensor, "P V"]
    start_length: Float[Tensor, "P S"]
    closest: Float[Tensor, "P S"]
    impact: Float[Tensor, "P S"]
    radius: float

    @classmethod
    def of(cls, path: Path, centre: Float[Tensor, "3"], radius: float, near: float) -> ContractedLength:
        positions, directions, s = (x.detach().double() for x in (path.positions, path.directions, path.s))
        offsets = centre - positions
        along = (offsets * directions).sum(-1)
        impact = (offsets.square().sum(-1) - along.square()).clamp(min=0).sqrt()
        closest = s + along
        start = torch.cat([s[:, 1:2].clamp(max=near), s[:, 1:]], 1)
        end = torch.cat([s[:, 1:], closest[:, -1:] + FAR * impact[:, -1:].clamp(min=radius)], 1)
        start_length = contracted_length(start - closest, impact, radius)
        lengths = contracted_length(end - closest, impact, radius) - start_length
        cumulative = torch.cat([torch.zeros_like(lengths[:, :1]), lengths.cumsum(1)], 1)
        return cls(cumulative, start_length, closest, impact, radius)

    @property
    def total(self) -> Float[Tensor, "P"]:
        return self.cumulative[:, -1]

    def arc_length(self, length: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
        """Convert contracted lengths from 0 to `total` to arc lengths."""
        last = self.start_length.shape[1] - 1
        segment = (torch.searchsorted(self.cumulative, length.contiguous().double()) - 1).clamp(0, last)
        start_length, closest, impact, before = (
            x.gather(1, segment) for x in (self.start_length, self.closest, self.impact, self.cumulative)
        )
        return closest + world_length(start_length + length - before, impact, self.radius)
