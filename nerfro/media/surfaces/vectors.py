"""Vectors in the settings of surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError


def vector(name: str, values: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Return three numbers as an array."""
    if len(values) != 3:
        raise NerfroError(f"surface.{name}={list(values)} is not allowed; give three numbers")
    return np.array(values, np.float64)
