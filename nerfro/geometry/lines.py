"""Intersection of lines in the least-squares sense."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def nearest_point(
    origins: Float[np.ndarray, "lines 3"], directions: Float[np.ndarray, "lines 3"]
) -> Float[np.ndarray, "3"]:
    """Return the point with the least sum of distances to lines, which is robust to outliers.

    Solved by iteratively reweighted least squares.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(origins))
    point = origins.mean(0)
    for _ in range(20):
        # If all lines are parallel, the small second term selects the point nearest to the mean of the origins.
        system = (weights[:, None, None] * across).sum(0) + 1e-9 * weights.sum() * np.eye(3)
        point = np.linalg.solve(
            system,
            (weights[:, None] * np.einsum("vij,vj->vi", across, origins)).sum(0)
            + 1e-9 * weights.sum() * origins.mean(0),
        )
        distance = np.linalg.norm(np.einsum("vij,vj->vi", across, point - origins), axis=1)
        weights = 1 / np.maximum(distance, 1e-3 * np.median(distance) + 1e-12)
        weights /= weights.max()
    return point
