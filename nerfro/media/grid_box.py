"""Box of the grid of a medium, with a margin of air around the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.geometry.box import corners_of_box
from nerfro.geometry.mesh import num_decimals

_AIR = 4  # voxels around the object if its box is not given
BYTES_PER_VERTEX = 64  # peak memory while a grid is built


def grid_box(
    box_min: Sequence[float] | None,
    box_max: Sequence[float] | None,
    bounds: Float[np.ndarray, "2 3"],
    resolution: int,
) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a medium's grid: the given ones, or the bounds of the object with a margin of air.

    A flat object gets a box at least half as thick as it is long, because voxels should not be much longer than wide.

    Args:
        box_min, box_max: given corners, world units; both None to use the bounds.
        bounds: corners of the object, world units.
        resolution: vertices along each side of the grid.

    Raises:
        NerfroError: one corner is given without the other, the corners do not make a box, or the object does not
            fit into it.
    """
    if box_min is not None and box_max is not None:
        box = corners_of_box(box_min, box_max)
        check_margin(bounds, box, resolution, 2)
        return box
    if box_min is not None or box_max is not None:
        raise NerfroError(
            "medium.box_min and medium.box_max belong together; give both, or neither for the bounds of the mesh"
        )
    low, high = bounds
    sides = np.maximum(high - low, 0.5 * (high - low).max())
    share = min(2 * _AIR / (resolution - 1), 0.5)
    return 0.5 * (low + high) + np.array([[-0.5], [0.5]]) * sides / (1 - share)


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
