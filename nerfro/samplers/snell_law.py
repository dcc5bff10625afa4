"""Snell's law, and Fresnel's."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional


def refract(
    directions: Float[Tensor, "R 3"],
    normals: Float[Tensor, "R 3"],
    n_before: Float[Tensor, "R"],
    n_after: Float[Tensor, "R"],
    reflected: Bool[Tensor, "R"] | None = None,
) -> tuple[Float[Tensor, "R 3"], Bool[Tensor, "R"]]:
    """Snell's law in vector form, and total reflection where it has no solution.

    With r = n_before / n_after, N against d and c = -N . d: t = r d + (r c - sqrt(1 - r^2 (1 - c^2))) N, or d + 2 c N.

    Args:
        directions: unit, towards the surface.
        normals: unit, of either orientation.
        n_before, n_after: index on the ray's side and beyond.
        reflected: which rays are reflected, where that is known already; else those without a solution.

    Returns:
        Unit directions after the event, and whether it was a reflection.
    """
    cosine = -(directions * normals).sum(-1)
    normals = torch.where(cosine[..., None] < 0, -normals, normals)
    cosine = cosine.abs()
    ratio = n_before / n_after
    squared = 1 - ratio**2 * (1 - cosine**2)
    total = squared <= 0
    reflected = total if reflected is None else reflected
    # The root of 1 where it is not used: that of zero or less would make gradients nan.
    root = torch.where(total, 1.0, squared).sqrt()
    along = torch.where(reflected, 2 * cosine, ratio * cosine - root)
    scale = torch.where(reflected, 1.0, ratio)
    after = scale[..., None] * directions + along[..., None] * normals
    return after / torch.linalg.vector_norm(after, dim=-1, keepdim=True), reflected


def reflectance(
    directions: Float[Tensor, "R 3"],
    normals: Float[Tensor, "R 3"],
    n_before: Float[Tensor, "R"],
    n_after: Float[Tensor, "R"],
) -> Float[Tensor, "R"]:
    """Share of unpolarised light that a surface reflects, by Fresnel's equations; 1 under total reflection.

    With r = n_before / n_after and cosines c, c': ((r c - c') / (r c + c'))^2 and ((c - r c') / (c + r c'))^2 are those
    of light polarised across and in the plane of incidence; their mean is returned. Arguments as for `refract`.
    """
    cosine = (directions * normals).sum(-1).abs()
    ratio = n_before / n_after
    squared = 1 - ratio**2 * (1 - cosine**2)
    total = squared <= 0
    beyond = torch.where(total, 1.0, squared).sqrt()
    across = (ratio * cosine - beyond) / (ratio * cosine + beyond)
    within = (cosine - ratio * beyond) / (cosine + ratio * beyond)
    return torch.where(total, 1.0, 0.5 * (across.square() + within.square()))


def turning_normals(
    before: Float[Tensor, "*batch 3"],
    after: Float[Tensor, "*batch 3"],
    n_before: Float[Tensor, "*batch"],
    n_after: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3"]:
    """Return unit normals of surfaces from how they turn rays: by Snell's law, n d changes along the normal alone.

    Args:
        before, after: unit directions of rays before and after the surface.
        n_before, n_after: index of the media in which the rays arrive and leave; equal for reflected rays.
    """
    change = n_before[..., None] * before - n_after[..., None] * after
    return functional.normalize(change, dim=-1, eps=torch.finfo(change.dtype).tiny)
