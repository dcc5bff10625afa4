"""Box of the grid of a medium, with a margin of air around the object."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import num_decimals

BYTES_PER_VERTEX = 64  # peak memory while a grid is built


def check_margin(bounds: Float[np.ndarray, "2 3"], box: Float[np.ndarray, "2 3"], resolution: int, voxels: int) -> None:
    """Refuse an object that leaves fewer than `voxels` voxels of air on a side of the box."""
    low, high = bounds
    margin = voxels * (box[1] - box[0]) / (resolution - 1)
    if (low - margin >= box[0]).all() and (high + margin <= box[1]).all():
        return
    # A larger box has larger voxels, so the margin is solved for.
    share = 2 * voxels / (resolution - 1)
    if share >= 0.9:
        raise NerfroError(
            f"medium.resolution={resolution} has no room for {voxels} voxels of air on each side; increase it"
        )
    margin = 0.5 * (high - low).max() * share / (1 - share)
    decimals = num_decimals(float((high - low).max()), 3)
    raise NerfroError(
        f"the object does not fit into the box with {voxels} voxels of air; it needs a box such as "
        f"medium.box_min={_rounded(low - margin, -1, decimals)} medium.box_max={_rounded(high + margin, 1, decimals)}"
    )


def _rounded(corner: Float[np.ndarray, "3"], direction: int, decimals: int) -> str:
    outward = np.floor if direction < 0 else np.ceil
    return "[" + ",".join(f"{value:.12g}" for value in outward(corner * 10.0**decimals) / 10.0**decimals) + "]"
