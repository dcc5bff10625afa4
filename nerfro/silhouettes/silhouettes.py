"""Outlines of masks with subpixel accuracy, silhouettes of meshes, and downscaling of images."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from nerfro.core.cameras import Cameras, Window
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh, subdivided

# Fits exclude every so many-th view, for validation.
VALIDATION_EVERY = 8
# Coverages up to this number count as 0, and coverages from 1 minus this number on as 1.
MASK_NOISE = 0.02


def outline_distance(mask: Float[np.ndarray, "H W"], blur: float = 1.0, reach: float = 1.5) -> Float[np.ndarray, "H W"]:
    """Compute the signed distance of each pixel centre to the outline of a mask.

    Near a straight outline, a blurred mask equals Phi(distance / blur) with the normal distribution function Phi.
    The inverse of Phi gives the distance with subpixel accuracy, for binary and antialiased masks. The blur shrinks
    curved outlines; the result is corrected for this bias if the mask is antialiased. The image border is not
    an outline.

    Args:
        mask: fraction of each pixel that the object covers.
        blur: standard deviation of the blur in pixels. With 1, the error on straight lines of a binary mask is 0.15
            pixels, and corners are preserved.
        reach: largest distance, in blur widths, at which the blurred mask determines the distance.

    Returns:
        Distances in pixels, positive inside.
    """
    inside = mask > 0.5
    if inside.all() or not inside.any():
        return np.where(inside, np.inf, -np.inf)
    distance = scipy.ndimage.distance_transform_edt
    counted = np.where(inside, distance(inside) - 0.5, 0.5 - distance(~inside))
    blurred = scipy.ndimage.gaussian_filter(np.asarray(mask, np.float64), blur, mode="nearest")
    refined = blur * scipy.special.ndtri(blurred.clip(1e-6, 1 - 1e-6))
    if is_antialiased(mask, counted):  # the curvature of a binary mask is dominated by noise
        # A blur shrinks an outline of radius r by its variance / 2r. The box filter of a pixel adds a variance of 1/12.
        refined -= 0.5 * (blur**2 + 1 / 12) * _level_curvature(refined).clip(-1, 1)
    distance = np.where((np.abs(refined) < reach * blur) & (np.abs(counted) < 2 * reach), refined, counted)
    # The sign agrees with the mask.
    return np.where(inside, distance.clip(min=1e-3), distance.clip(max=-1e-3)).astype(np.float32)


def is_antialiased(masks: Float[np.ndarray, "*V H W"], distances: Float[np.ndarray, "*V H W"]) -> bool:
    """Test whether a fifth of the pixels on the outlines has partial coverage, as antialiased masks have.

    Args:
        masks: coverage of the pixels.
        distances: distances of the pixel centres to the outlines, in pixels.
    """
    partial = ((masks > MASK_NOISE) & (masks < 1 - MASK_NOISE))[np.abs(distances) < 1]
    return bool(partial.any() and partial.mean() > 0.2)


def _level_curvature(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Compute the curvature of the level lines in 1 / pixels, negative around maxima."""
    down, right = np.gradient(values)
    (down_down, down_right), (_, right_right) = np.gradient(down), np.gradient(right)
    across = right_right * down**2 - 2 * down * right * down_right + down_down * right**2
    return across / np.hypot(down, right).clip(0.3) ** 3


def border_pixels(masks: Float[Tensor, "V H W"]) -> Bool[Tensor, "V Q"]:
    """Test which pixels along the border of each mask show the object, which may then continue outside the image."""
    inside = masks > 0.5
    return torch.cat([inside[:, [0, -1]].flatten(1), inside[:, :, [0, -1]].flatten(1)], 1)


def intersection_over_union(
    ours: Bool[np.ndarray, "*V H W"], theirs: Bool[np.ndarray, "*V H W"]
) -> Float[np.ndarray, "*V"]:
    """Compute the intersection over union of masks; 1 where both are empty."""
    both, either = (ours & theirs).sum((-2, -1)), (ours | theirs).sum((-2, -1))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def pixel_stride(cameras: Cameras, max_pixels: int) -> int:
    """Return the subsampling stride for which an image has at most `max_pixels` per side."""
    return -(-max(cameras.width, cameras.height) // max_pixels)


class PixelBlocks:
    """Downscaling of images by averaging square blocks; incomplete blocks at the right and bottom are cropped.

    Args:
        cameras: cameras of the images.
        max_pixels: maximum length of the longer side after downscaling.
    """

    def __init__(self, cameras: Cameras, max_pixels: int) -> None:
        self._stride = pixel_stride(cameras, max_pixels)
        self.height, self.width = cameras.height // self._stride, cameras.width // self._stride
        self._window = Window(0, 0, self.height * self._stride, self.width * self._stride)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras of the downscaled images."""
        return cameras.crop(self._window).resized(self.width, self.height)

    def mean(self, image: Shaped[Tensor, "H W *C"]) -> Float[Tensor, "h w *C"]:
        """Average an image over each block."""
        blocks = self._window.cut(image.float()[None])[0].unflatten(1, (self.width, self._stride))
        return blocks.unflatten(0, (self.height, self._stride)).mean((1, 3))


def mesh_silhouettes(mesh: TriangleMesh, cameras: Cameras, stride: int) -> Bool[Tensor, "V h w"]:
    """Test whether the rays through the centres of every stride-th pixel intersect a mesh."""
    margin = 8  # pixels around the projected vertices, because lens distortion bends edges between them
    short = mesh if cameras.distortion is None else subdivided(mesh, np.ptp(mesh.bounds, axis=0).max() / 16)
    intersector, vertices = MeshIntersector(mesh.triangles), torch.from_numpy(short.vertices).float()
    row, column = torch.meshgrid(
        torch.arange(0, cameras.height, stride), torch.arange(0, cameras.width, stride), indexing="ij"
    )
    seen = torch.zeros(len(cameras), *row.shape, dtype=torch.bool)
    for view in range(len(cameras)):
        pixels, depth = cameras.select([view]).project(vertices)
        (left, top), (right, bottom) = pixels[0].amin(0) - margin, pixels[0].amax(0) + margin
        near = (row >= top) & (row <= bottom) & (column >= left) & (column <= right)
        near |= depth.amin() <= 0  # pixels of points behind the camera are invalid
        rays = cameras.rays(torch.full((int(near.sum()),), view), row[near], column[near])
        seen[view, near] = intersector.first_hits(rays.origins, rays.directions) >= 0
    return seen
