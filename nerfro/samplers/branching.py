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
