"""Light adds in linear radiance; sRGB is how pictures store it (IEC 61966-2-1)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def to_linear(srgb: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Linear radiance of sRGB values; 1 is the brightest that a picture stores."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """sRGB values of linear radiance; the curve goes on beyond 1, so that gradients do not end there."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def clipped_alike(target: Float[Tensor, "*batch"], prediction: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The target, but the prediction itself (without gradient) where both are at or beyond what a picture stores.

    A saturated pixel says no more than "at least 1": a brighter prediction is not wrong there. Where the prediction
    alone is saturated, it is, and its gradient stays.
    """
    return torch.where((target >= 1) & (prediction > 1), prediction.detach(), target)
