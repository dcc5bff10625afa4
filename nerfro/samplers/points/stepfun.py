"""Step functions on intervals of arc length, and sampling from step functions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.types import Path


def volume_weights(
    density: Float[Tensor, "P N"], deltas: Float[Tensor, "P N"]
) -> tuple[Float[Tensor, "P N"], Float[Tensor, "P"]]:
    """Compute the weights w_i = T_i (1 - exp(-sigma_i delta_i)) and the transmittance T_{N+1} (paper, Eqn. 1).

    Args:
        density: density per world unit.
        deltas: interval lengths in world units.

    Returns:
        Weights and transmittance, which sum to one on every ray.
    """
    optical_depth = density * deltas
    total = optical_depth.cumsum(-1)
    transmittance = torch.exp(-torch.cat([torch.zeros_like(total[:, :1]), total], dim=-1))
    weights = -torch.expm1(-optical_depth) * transmittance[:, :-1]
    return weights, transmittance[:, -1]


def spread_uniform(path: Path, num_samples: int, draws: Draws | None, stream: str = "samples") -> Float[Tensor, "P N"]:
    """Spread numbers over [0, 1), ascending along each polyline.

    With `draws`, there is one uniform number in each of `num_samples` equal bins (paper, Eqn. 2). Without, the
    numbers are evenly spaced and include both ends, 0 and 1 - eps, as the authors' code does in evaluation.
    """
    like = path.s
    if draws is not None:
        jitter = draws.for_rays(path.ray, num_samples, stream).to(like)
        return (torch.arange(num_samples, device=like.device, dtype=like.dtype) + jitter) / num_samples
    eps = torch.finfo(like.dtype).eps
    return torch.linspace(0.0, 1.0 - eps, num_samples, device=like.device, dtype=like.dtype).expand(len(like), -1)


def invert_cdf(
    edges: Float[Tensor, "P E"], weights: Float[Tensor, "P E-1"], u: Float[Tensor, "P N"]
) -> Float[Tensor, "P N"]:
    """Sample a step function by inversion of its cumulative distribution (paper, Eqn. 3).

    Args:
        edges: bounds of the intervals, ascending.
        weights: weight of each interval, in which the density is constant; the sum need not be 1.
        u: values of the cumulative distribution in [0, 1).

    Returns:
        Positions, which ascend if `u` ascends.
    """
    num_bins = weights.shape[-1]
    total = weights.sum(-1, keepdim=True)
    # Rays with a smaller total weight are sampled uniformly, as in the code of mip-NeRF.
    padding = (1e-5 - total).clamp(min=0)
    pdf = (weights + padding / num_bins) / (total + padding)
    cdf = pdf[..., :-1].cumsum(-1).clamp(max=1.0)
    cdf = torch.cat([torch.zeros_like(total), cdf, torch.ones_like(total)], dim=-1)
    index = (torch.searchsorted(cdf, u.contiguous(), right=True) - 1).clamp(0, num_bins - 1)
    low, high = cdf.gather(-1, index), cdf.gather(-1, index + 1)
    fraction = ((u - low) / (high - low).clamp(min=torch.finfo(u.dtype).tiny)).clamp(0.0, 1.0)
    left, right = edges.gather(-1, index), edges.gather(-1, index + 1)
    return left + fraction * (right - left)


def midpoints(edges: Float[Tensor, "*rows E"]) -> Float[Tensor, "*rows E-1"]:
    """Return the middle of each interval."""
    return 0.5 * (edges[..., 1:] + edges[..., :-1])
