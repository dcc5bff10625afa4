"""Outlines of masks to a fraction of a pixel, and the silhouettes that a mesh throws."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.special import ndtri
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.geometry.intersection import MeshIntersector

# Standard deviation of the blur in which the outline is found, pixels: enough to see between a binary mask's steps (an
# error of 0.15 pixels on straight lines), and little enough to keep corners (a bend of radius r moves in by 1 / 2r).
_BLUR = 1.0
# Farther from the outline than this the blur knows nothing, and the distance is counted from pixel to pixel.
_REACH = 1.5
# Inside and outside stay what the mask says, by at least this many pixels.
_LEAST = 0.05


def outline_distance(mask: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Signed distance of each pixel's centre to a mask's outline, pixels, positive inside.

    Near a straight outline a blurred mask is Phi(distance / blur), Phi the normal distribution's integral; the inverse
    of that gives places between the pixels, for binary masks as well as for those that hold shares. The frame of the
    image is no outline.

    Args:
        mask: share of each pixel that the object covers.
    """
    inside = mask > 0.5
    if inside.all() or not inside.any():
        return np.where(inside, np.inf, -np.inf)
    counted = np.where(inside, distance_transform_edt(inside) - 0.5, 0.5 - distance_transform_edt(~inside))
    blurred = gaussian_filter(np.asarray(mask, np.float64), _BLUR, mode="nearest")
    refined = _BLUR * ndtri(blurred.clip(1e-6, 1 - 1e-6))
    distance = np.where((np.abs(refined) < _REACH * _BLUR) & (np.abs(counted) < 2 * _REACH), refined, counted)
    return np.where(inside, distance.clip(min=_LEAST), distance.clip(max=-_LEAST)).astype(np.float32)


def is_cut_by_frame(masks: Float[Tensor, "V H W"]) -> Bool[Tensor, "V"]:
    """Which masks touch the frame of their image, so that the object may go on beyond it."""
    inside = masks > 0.5
    return inside[:, [0, -1]].flatten(1).any(1) | inside[:, :, [0, -1]].flatten(1).any(1)


def pixel_stride(cameras: Cameras, max_pixels: int) -> int:
    """Every how many pixels an image is looked at, so that there are at most `max_pixels` a side."""
    return -(-max(cameras.width, cameras.height) // max_pixels)


def mesh_silhouette(intersector: MeshIntersector, cameras: Cameras, view: int, stride: int) -> Bool[Tensor, "h w"]:
    """Where the rays through the centres of every stride-th pixel, from the first on, meet a mesh."""
    row, column = torch.meshgrid(
        torch.arange(0, cameras.height, stride), torch.arange(0, cameras.width, stride), indexing="ij"
    )
    rays = cameras.rays(torch.full_like(row, view).flatten(), row.flatten(), column.flatten())
    return (intersector.first_hits(rays.origins, rays.directions) >= 0).view(row.shape)


def intersection_over_union(ours: Bool[Tensor, "h w"], theirs: Bool[Tensor, "h w"]) -> float:
    """Of two silhouettes; 1 where both are empty."""
    either = int((ours | theirs).sum())
    return int((ours & theirs).sum()) / either if either else 1.0
