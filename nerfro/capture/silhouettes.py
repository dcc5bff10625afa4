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
from nerfro.geometry.mesh import TriangleMesh

# Standard deviation of the blur in which the outline is found, pixels: enough to see between a binary mask's steps (an
# error of 0.15 pixels on straight lines), and little enough to keep corners.
_BLUR = 1.0
# A blur moves a bend of radius r in by its variance / 2r, and a pixel's share is a blur, too.
_SHIFT = 0.5 * (_BLUR**2 + 1 / 12)
# Where so many of the pixels on the outline have shares, a mask holds shares. Bends of binary masks are noise.
_SOFT = 0.2
# Farther from the outline than this the blur knows nothing, and the distance is counted from pixel to pixel.
_REACH = 1.5
# Inside and outside stay what the mask says, by at least this many pixels.
_LEAST = 1e-3


def outline_distance(mask: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Signed distance of each pixel's centre to the outline of a mask of shares, pixels, positive inside.

    Near a straight outline a blurred mask is Phi(distance / blur), Phi the normal distribution's integral; the inverse
    of that gives places between the pixels, for binary masks as well as for those that hold shares. In those, where
    curvature can be told, it mends that the blur has moved bends in. The frame of the image is no outline.
    """
    inside = mask > 0.5
    if inside.all() or not inside.any():
        return np.where(inside, np.inf, -np.inf)
    counted = np.where(inside, distance_transform_edt(inside) - 0.5, 0.5 - distance_transform_edt(~inside))
    blurred = gaussian_filter(np.asarray(mask, np.float64), _BLUR, mode="nearest")
    refined = _BLUR * ndtri(blurred.clip(1e-6, 1 - 1e-6))
    if holds_shares(mask, counted):
        refined -= _SHIFT * _level_curvature(refined).clip(-1, 1)
    distance = np.where((np.abs(refined) < _REACH * _BLUR) & (np.abs(counted) < 2 * _REACH), refined, counted)
    return np.where(inside, distance.clip(min=_LEAST), distance.clip(max=-_LEAST)).astype(np.float32)


def holds_shares(masks: Float[np.ndarray, "*V H W"], distances: Float[np.ndarray, "*V H W"]) -> bool:
    """Whether masks tell shares of the pixels on their outlines, and not only which are inside.

    Args:
        masks: shares of pixels.
        distances: of the pixels' centres to the outlines, pixels.
    """
    shares = ((masks > 0.02) & (masks < 0.98))[np.abs(distances) < 1]
    return bool(shares.any() and shares.mean() > _SOFT)


def _level_curvature(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Curvature of the lines of equal values, 1 / pixels, negative where they bend around larger ones."""
    down, right = np.gradient(values)
    (down_down, down_right), (_, right_right) = np.gradient(down), np.gradient(right)
    across = right_right * down**2 - 2 * down * right * down_right + down_down * right**2
    return across / np.hypot(down, right).clip(0.3) ** 3


def frame_pixels(masks: Float[Tensor, "V H W"]) -> Bool[Tensor, "V P"]:
    """Whether the pixels along the frame of each mask are object, so that it may go on beyond it."""
    inside = masks > 0.5
    return torch.cat([inside[:, [0, -1]].flatten(1), inside[:, :, [0, -1]].flatten(1)], 1)


def pixel_stride(cameras: Cameras, max_pixels: int) -> int:
    """Every how many pixels an image is looked at, so that there are at most `max_pixels` a side."""
    return -(-max(cameras.width, cameras.height) // max_pixels)


def mesh_silhouettes(mesh: TriangleMesh, cameras: Cameras, stride: int) -> Bool[Tensor, "V h w"]:
    """Where the rays through the centres of every stride-th pixel, from the first on, meet a mesh."""
    intersector = MeshIntersector(mesh.triangles)
    rows, columns = torch.arange(0, cameras.height, stride), torch.arange(0, cameras.width, stride)
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    seen = []
    for view in range(len(cameras)):
        rays = cameras.rays(torch.full_like(row, view).flatten(), row.flatten(), column.flatten())
        seen.append((intersector.first_hits(rays.origins, rays.directions) >= 0).view(row.shape))
    return torch.stack(seen)
