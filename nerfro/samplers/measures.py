"""The length in which a polyline is sampled evenly: its own within a box, or that in contracted space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.geometry.contraction import FAR, contracted_length, world_length
from nerfro.types import Path


@dataclass(frozen=True)
class WithinBox:
    """Arc length itself, from a path's first entry into a box to its last exit."""

    first: Float[Tensor, "P"]
    total: Float[Tensor, "P"]  # of all that is sampled

    @classmethod
    def of(cls, path: Path, box: Float[Tensor, "2 3"]) -> WithinBox:
        first, last = path.span(box)
        return cls(first, last - first)

    def arc_length(self, place: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
        return self.first[:, None] + place


@dataclass(frozen=True)
class Contracted:
    """Arc length times the contraction scale, added up over all runs; from near to practical infinity.

    The first run is followed back, and the last one on, as far as is needed, whatever the path's own ends.
    """

    marks: Float[Tensor, "P S+1"]  # measure at the beginning of each run, and in all
    begin: Float[Tensor, "P S"]  # contracted length from the run's nearest place to the centre to its beginning
    passing: Float[Tensor, "P S"]  # arc length at that place
    aside: Float[Tensor, "P S"]  # distance from the centre there
    radius: float

    @classmethod
    def of(cls, path: Path, centre: Float[Tensor, "3"], radius: float, near: float) -> Contracted:
        positions, directions, s = (x.detach().double() for x in (path.positions, path.directions, path.s))
        offsets = centre - positions
        along = (offsets * directions).sum(-1)
        aside = (offsets.square().sum(-1) - along.square()).clamp(min=0).sqrt()
        passing = s + along
        start = torch.cat([s[:, 1:2].clamp(max=near), s[:, 1:]], 1)
        end = torch.cat([s[:, 1:], passing[:, -1:] + FAR * aside[:, -1:].clamp(min=radius)], 1)
        begin = contracted_length(start - passing, aside, radius)
        lengths = contracted_length(end - passing, aside, radius) - begin
        marks = torch.cat([torch.zeros_like(begin[:, :1]), lengths.cumsum(1)], 1)
        return cls(marks, begin, passing, aside, radius)

    @property
    def total(self) -> Float[Tensor, "P"]:
        return self.marks[:, -1]

    def arc_length(self, place: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
        """Arc lengths at places from 0 to `total`."""
        last = self.begin.shape[1] - 1
        run = (torch.searchsorted(self.marks, place.contiguous().double()) - 1).clamp(0, last)
        begin, passing, aside, mark = (x.gather(1, run) for x in (self.begin, self.passing, self.aside, self.marks))
        return passing + world_length(begin + place - mark, aside, self.radius)
