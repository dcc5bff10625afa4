"""Positional encodings."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

# Octaves of the encoded viewing direction in NeRF, mip-NeRF and the paper.
DIRECTION_DEGREE = 4


def positional_encoding(x: Float[Tensor, "*batch D"], num_octaves: int) -> Float[Tensor, "*batch F"]:
    """Encode x by sines and cosines at the octaves 1, 2, 4, ... (NeRF, Eqn. 4).

    As in mip-NeRF's code, frequencies have no factor pi and x is not normalized.

    Returns:
        x, all sines, and all cosines; F = D (2 num_octaves + 1).
    """
    scales = 2.0 ** torch.arange(num_octaves, device=x.device, dtype=x.dtype)
    angles = (x[..., None, :] * scales[:, None]).flatten(-2)
    return torch.cat([x, torch.sin(torch.cat([angles, angles + 0.5 * math.pi], dim=-1))], dim=-1)


def integrated_positional_encoding(
    mean: Float[Tensor, "*batch 3"], variance: Float[Tensor, "*batch 3"], num_octaves: int
) -> Float[Tensor, "*batch F"]:
    """Return expected sines and cosines of a Gaussian with diagonal covariance (mip-NeRF, Eqn. 13)."""
    scales = 2.0 ** torch.arange(num_octaves, device=mean.device, dtype=mean.dtype)
    angles = (mean[..., None, :] * scales[:, None]).flatten(-2)
    damping = torch.exp(-0.5 * (variance[..., None, :] * scales[:, None] ** 2).flatten(-2))
    return torch.cat([torch.sin(angles) * damping, torch.sin(angles + 0.5 * math.pi) * damping], dim=-1)
