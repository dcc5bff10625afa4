"""Training views that are held back: not trained on, to be looked at while training."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.data.base import DataSource, Views
from nerfro.errors import NerfroError


class HeldBack(DataSource):
    """Data of which some training views are the `val` split instead.

    Args:
        source: the data as they are.
        number: of views, spread over the places of the training cameras; see `spread`.
    """

    def __init__(self, source: DataSource, number: int) -> None:
        self._source, self._number = source, number
        self.root = source.root

    @property
    def splits(self) -> list[str]:
        names = self._source.splits
        return names if "val" in names else [*names, "val"]

    def load(self, split: str) -> Views:
        if split not in ("train", "val"):
            return self._source.load(split)
        views = self._source.load("train")
        if self._number >= len(views):
            raise NerfroError(
                f"batches.hold_back={self._number} leaves nothing to train on: there are {len(views)} training views; "
                "hold back fewer"
            )
        places, trained = views.cameras.camera_to_world[:, :, 3].double().cpu().numpy(), len(views) - self._number
        fewer = spread(places, min(self._number, trained))  # the more are what is left, and so spread as well
        others = [view for view in range(len(views)) if view not in fewer]
        return views.select(fewer if (split == "val") == (self._number <= trained) else others)


def spread(places: Float[np.ndarray, "V 3"], number: int) -> list[int]:
    """Some of the places, such that all others are near to one of them, in ascending order.

    One after the other is taken that most lessens the sum of distances to the nearest one taken (greedy k-medians).
    So they stand among the others: the outermost, which nothing could stand in for, are left.
    """
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    nearest, taken = np.full(len(places), np.inf), np.zeros(len(places), bool)
    for _ in range(number):
        sums = np.minimum(distances, nearest).sum(-1)
        best = int(np.where(taken, np.inf, sums).argmin())
        taken[best], nearest = True, np.minimum(nearest, distances[best])
    return np.flatnonzero(taken).tolist()
