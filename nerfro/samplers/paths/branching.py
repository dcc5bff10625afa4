"""Selection of the branches of light that is partly reflected and partly transmitted."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Branching(NamedTuple):
    """Rule for splitting: light splits if both parts have enough weight; otherwise, the heavier part takes all weight.

    Therefore the weights of all polylines of a ray sum to 1 (with `main_only`, one of them is followed), and a ray has
    at most 1 / least_weight polylines.

    Attributes:
        max_split_events: number of first events of a polyline at which light may split; at later events, all light is
            transmitted unless it is totally reflected.
        least_weight: share of the light of a ray below which a part is not followed.
        main_only: whether only the first polyline of each ray is followed.
    """

    max_split_events: int = 0
    least_weight: float = 1.0
    main_only: bool = False

    def decide(
        self, weight: Float[Tensor, "A"], reflectance: Float[Tensor, "A"], num_events: Int[Tensor, "A"]
    ) -> tuple[Bool[Tensor, "A"], Bool[Tensor, "A"]]:
        """Decide which polylines split at an event, and which are wholly reflected although light is transmitted.

        Args:
            weight: weight of each polyline.
            reflectance: Fresnel reflectance, 1 for total reflection.
            num_events: number of earlier events of each polyline.
        """
        may = (num_events < self.max_split_events) & (reflectance < 1)
        splits = may & (weight * torch.minimum(reflectance, 1 - reflectance) >= self.least_weight)
        return splits, may & ~splits & (reflectance > 0.5)


ONE_PATH = Branching()
