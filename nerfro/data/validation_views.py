"""Validation views that are taken from the training views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.data.base import DataSource, Views


class WithValidationViews(DataSource):
    """Use some training views of a data set as its `val` split instead.

    Args:
        source: the data set.
        number: number of validation views; `spread` distributes these over the camera positions.
    """

    def __init__(self, source: DataSource, number: int) -> None:
        self._source, self._number = source, number
        self.root, self.origin = source.root, source.origin

    def cameras_of(self, file: Path) -> Cameras | None:
        return self._source.cameras_of(file)

    @property
    def splits(self) -> list[str]:
        names = self._source.splits
        return names if "val" in names else [*names, "val"]

    def load(self, split: str) -> Views:
        if split not in ("train", "val"):
            return self._source.load(split)
        views = self._source.load("train")
        num_training = len(views) - self._number
        if num_training < 1:
            raise NerfroError(
                f"batches.num_validation_views={self._number} leaves no view to train on: "
                f"there are {len(views)} training views; "
                f"take at most {len(views) - 1}"
            )
        positions = views.cameras.camera_to_world[:, :, 3].double().cpu().numpy()
        # The smaller group is the spread one; the views that remain are then distributed as well.
        spread_views = spread(positions, min(self._number, num_training))
        others = [view for view in range(len(views)) if view not in spread_views]
        return views.select(spread_views if (split == "val") == (self._number <= num_training) else others)


def spread(positions: Float[np.ndarray, "V 3"], number: int) -> list[int]:
    """Select positions so that every other position is close to a selected one (greedy k-medians).

    Each step adds the position that reduces the sum of distances to the nearest selected position most. The outermost
    positions are rarely selected, which is intended: no other training view could replace an outermost one.

    Returns:
        Indices of the selected positions, ascending.
    """
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    nearest, selected = np.full(len(positions), np.inf), np.zeros(len(positions), bool)
    for _ in range(number):
        sums = np.minimum(distances, nearest).sum(-1)
        best = int(np.where(selected, np.inf, sums).argmin())
        selected[best], nearest = True, np.minimum(nearest, distances[best])
    return np.flatnonzero(selected).tolist()
