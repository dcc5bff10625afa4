"""Gaussian smoothing and differences of grids."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError


def smooth(values: Float[Tensor, "X Y Z"], size: int, sigma: float) -> Float[Tensor, "X Y Z"]:
    """Convolve with a normalised Gaussian of size^3 taps; the border repeats outwards. Size 0 changes nothing.

    Raises:
        NerfroError: the size is even or negative, or sigma is not positive.
    """
    if size == 0:
        return values
    if size < 0 or size % 2 == 0 or not sigma > 0:
        raise NerfroError(
            f"smoothing_size={size}, smoothing_sigma={sigma} is no kernel; "
            "the size must be odd (or 0 for none) and sigma positive"
        )
    taps = torch.exp(-0.5 * ((torch.arange(size, dtype=torch.float64) - size // 2) / sigma) ** 2)
    weights = (taps / taps.sum()).tolist()
    for axis in range(3):
        length = values.shape[axis]
        # Shifted sums of whole grids: much faster than a convolution with a single channel.
        padded = _repeat_border(values, axis, size // 2)
        values = weights[0] * padded.narrow(axis, 0, length)
        for shift in range(1, size):
            values.add_(padded.narrow(axis, shift, length), alpha=weights[shift])
    return values


def _repeat_border(values: Tensor, axis: int, count: int) -> Tensor:
    first, last = values.narrow(axis, 0, 1), values.narrow(axis, values.shape[axis] - 1, 1)
    return torch.cat([*[first] * count, values, *[last] * count], axis)


def gradient(values: Float[Tensor, "X Y Z"], spacing: Float[Tensor, "3"]) -> Float[Tensor, "X Y Z 3"]:
    """Central differences, (next - previous) / 2h; the border repeats outwards, so its gradient is half."""
    parts = []
    for axis in range(3):
        padded = _repeat_border(values, axis, 1)
        ahead, behind = padded.narrow(axis, 2, values.shape[axis]), padded.narrow(axis, 0, values.shape[axis])
        parts.append((ahead - behind) / (2 * spacing[axis]))
    return torch.stack(parts, -1)
