"""Conversion between linear radiance, which is additive, and sRGB, the encoding of images (IEC 61966-2-1)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Values = TypeVar("Values", Tensor, np.ndarray)  # of any shape


def to_linear(srgb: Values) -> Values:
    """Decode sRGB to linear radiance; 1 is the maximum of an image."""
    if isinstance(srgb, np.ndarray):
        return to_linear(_tensor(srgb)).numpy()
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Values) -> Values:
    """Encode linear radiance as sRGB; the curve continues beyond 1, so that gradients do not vanish."""
    if isinstance(linear, np.ndarray):
        return to_srgb(_tensor(linear)).numpy()
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def clipped_alike(target: Float[Tensor, "*batch"], prediction: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Replace saturated targets by the prediction (without gradient) if the prediction is saturated, too.

    The true value of a saturated pixel is unknown and at least 1, so a brighter prediction is not wrong. If only the
    prediction is saturated, the target remains.
    """
    return torch.where((target >= 1) & (prediction > 1), prediction.detach(), target)


def _tensor(values: np.ndarray) -> Tensor:
    # torch does not support negative strides.
    return torch.from_numpy(np.asarray(values, order="C"))
