"""Light adds in linear radiance; sRGB is how pictures store it (IEC 61966-2-1)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Values = TypeVar("Values", Tensor, np.ndarray)  # of any shape


def to_linear(srgb: Values) -> Values:
    """Linear radiance of sRGB values; 1 is the brightest that a picture stores."""
    if isinstance(srgb, np.ndarray):
        return to_linear(_tensor(srgb)).numpy()
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Values) -> Values:
    """sRGB values of linear radiance; the curve goes on beyond 1, so that gradients do not end there."""
    if isinstance(linear, np.ndarray):
        return to_srgb(_tensor(linear)).numpy()
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def clipped_alike(target: Float[Tensor, "*batch"], prediction: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The target, but the prediction itself (without gradient) where both are at or beyond what a picture stores.

    A saturated pixel says no more than "at least 1": a brighter prediction is not wrong there. Where the prediction
    alone is saturated, it is, and its gradient stays.
    """
    return torch.where((target >= 1) & (prediction > 1), prediction.detach(), target)


def _tensor(values: np.ndarray) -> Tensor:
    # torch knows no negative strides.
    return torch.from_numpy(np.asarray(values, order="C"))
