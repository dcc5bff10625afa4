"""Axis-aligned boxes of settings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import FURTHEST


def corners_of_box(box_min: Sequence[float], box_max: Sequence[float]) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box as an array.

    Args:
        box_min, box_max: lower and upper corner, world units.

    Raises:
        NerfroError: a corner does not have three numbers or is farther than 10^7 units from the origin, or the lower
            corner is not below the upper one.
    """
    box = np.array([box_min, box_max], np.float64) if len(box_min) == len(box_max) == 3 else np.zeros((2, 3))
    if not (box[1] > box[0]).all() or not (np.abs(box) <= FURTHEST).all():
        raise NerfroError(
            f"box_min={list(box_min)}, box_max={list(box_max)} is not a box; give three numbers each, min below max, "
            f"and none beyond {FURTHEST}"
        )
    return box
