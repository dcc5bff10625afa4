"""Light that is partly reflected and partly transmitted: which parts of it are followed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Branching:
    """A ray splits where both parts of its light are heavy enough; else the heavier part takes the weight of both.

    So the weights of a ray's polylines always sum to 1, and there are at most 1 / least_weight of them.

    Attributes:
        num_events: at how many of its first events a ray may split; at later ones all light is transmitted where it
            can be.
        least_weight: share of the ray's light below which a part is not followed.
        main_only: whether only a ray's first polyline is followed, though its light splits.
    """

    num_events: int = 0
    least_weight: float = 1.0
    main_only: bool = False

    def decide(
        self, weight: Float[Tensor, "A"], reflectance: Float[Tensor, "A"], num_events: Int[Tensor, "A"]
    ) -> tuple[Bool[Tensor, "A"], Bool[Tensor, "A"]]:
        """Which polylines split at an event, and which are reflected whole though they might be transmitted.

        Args:
            weight: of each polyline so far.
            reflectance: Fresnel's, 1 under total reflection.
            num_events: that each has had before.
        """
        may = (num_events < self.num_events) & (reflectance < 1)
        splits = may & (weight * torch.minimum(reflectance, 1 - reflectance) >= self.least_weight)
        return splits, may & ~splits & (reflectance > 0.5)


ONE_PATH = Branching()


class Event:
    """Rows that have met a surface, and how rows multiply there: the reflected part comes right after the other.

    Args:
        branching: which parts are followed.
        active: rows that have met a surface.
        weight, num_events: of all rows so far.
        share: reflectance for each active row, 0 where there is nothing to see.
        reflected: active rows that are totally reflected.

    Attributes:
        source: the former row of each row.
        row: the row of each former row, of its transmitted part where it splits.
        active: the active rows now.
        place: the former place in `active` of each of these.
        reflected: which of these are reflected.
        factor: of their weight.
    """

    def __init__(
        self,
        branching: Branching,
        active: Int[Tensor, "A"],
        weight: Float[Tensor, "R"],
        num_events: Int[Tensor, "R"],
        share: Float[Tensor, "A"],
        reflected: Bool[Tensor, "A"],
    ) -> None:
        splits, whole = branching.decide(weight[active], share, num_events[active])
        copies = torch.ones(len(weight), dtype=torch.long, device=active.device)
        followed = splits & (not branching.main_only)
        copies[active] += followed
        self.source = torch.arange(len(weight), device=active.device).repeat_interleave(copies)
        self.place = torch.arange(len(active), device=active.device).repeat_interleave(1 + followed.long())
        second = torch.zeros_like(self.place, dtype=torch.bool)
        second[1:] = self.place[1:] == self.place[:-1]
        self.row = copies.cumsum(0) - copies
        self.active = self.row[active[self.place]] + second
        self.reflected = (reflected | whole)[self.place] | second
        share = share[self.place]
        self.factor = torch.where(splits[self.place], torch.where(second, share, 1 - share), 1.0)
