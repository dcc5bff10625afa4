"""Snell's law and the Fresnel equations."""

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
    """Refract rays by Snell's law in vector form, and reflect rays for which the law has no solution.

    With r = n_before / n_after, N against d and c = -N . d, the direction is r d + (r c - sqrt(1 - r^2 (1 - c^2))) N
    for refraction, and d + 2 c N for reflection.

    Args:
        directions: unit directions towards the surface.
        normals: unit normals of either orientation.
        n_before, n_after: refractive index on the near side and on the far side of the surface.
        reflected: whether each ray is reflected; by default, rays without a solution are reflected.

    Returns:
        Unit directions after the event, and whether the event is a reflection.
    """
    cosine = -(directions * normals).sum(-1)
    normals = torch.where(cosine[..., None] < 0, -normals, normals)
    cosine = cosine.abs()
    ratio = n_before / n_after
    squared = 1 - ratio**2 * (1 - cosine**2)
    total = squared <= 0
    reflected = total if reflected is None else reflected
    # Unused roots are taken of 1, because a root of zero or less would make gradients NaN.
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
    """Compute the reflectance of a surface for unpolarized light by the Fresnel equations; 1 for total reflection.

    With r = n_before / n_after and cosines c, c', the reflectance is the mean of ((r c - c') / (r c + c'))^2 for light
    polarized across the plane of incidence and ((c - r c') / (c + r c'))^2 for light polarized in the plane.
    See `refract` for the arguments.
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
    """Compute unit normals of surfaces from the directions of rays: by Snell's law, n d changes along the normal only.

    Args:
        before, after: unit directions of rays before and after the surface.
        n_before, n_after: refractive index where the rays arrive and where they leave; equal for reflected rays.
    """
    change = n_before[..., None] * before - n_after[..., None] * after
    return functional.normalize(change, dim=-1, eps=torch.finfo(change.dtype).tiny)
