"""Depths of a data set as arc lengths, the map `depth` of `Views`: depth images, and points of COLMAP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.data.image_files import read_levels
from nerfro.files.reading import reading

DEPTH = "depth"  # name of the map


def read_depths(files: Sequence[Path | None], unit: float, cameras: Cameras) -> Float[Tensor, "V H W 1"]:
    """Read depths along the optical axis, and convert them to arc lengths of straight rays through the pixel centres.

    Each pixel takes the nearest depth of the file, because means across an edge belong to no surface.

    Args:
        files: one image (16 bits) or array (.npy) [H, W] per camera, in any resolution; None for a view without depths.
        unit: world units per level of a file.
        cameras: cameras of the views, with the lenses of the given resolution.

    Returns:
        Arc lengths in world units; 0 where a file has no measurement (0, or not finite).

    Raises:
        NerfroError: a file is missing or damaged, or is no image of one channel.
    """
    size = cameras.height, cameras.width
    depths = torch.zeros(len(files), *size, 1)
    for view, file in enumerate(files):
        if file is None:
            continue
        levels = _read(file)
        rows, columns = (
            ((np.arange(length) + 0.5) * stored / length).astype(int)
            for length, stored in zip(size, levels.shape, strict=True)
        )
        along_axis = torch.from_numpy(np.nan_to_num(levels[rows][:, columns], nan=0, posinf=0, neginf=0) * unit)
        cosine = -cameras.image_rays(view).directions @ cameras.camera_to_world[view, :, 2]
        depths[view] = (along_axis.clamp(min=0).float() / cosine.view(size))[..., None]
    return depths


def depths_of_points(points: Sequence[Float[np.ndarray, "_ 3"]], cameras: Cameras) -> Float[Tensor, "V H W 1"]:
    """Compute the distances from each camera to the 3-D points that it has observed.

    Args:
        points: points of each view, in the coordinates of the cameras.
        cameras: cameras of the views.

    Returns:
        Distance of the nearest point in each pixel, world units; 0 in pixels without a point.
    """
    height, width = cameras.height, cameras.width
    depths = torch.zeros(len(points), height, width, 1)
    for view, seen in enumerate(points):
        positions = torch.from_numpy(seen).float()
        pixels, along_axis = cameras.select([view]).project(positions)
        column, row = pixels[0].floor().long().unbind(-1)
        visible = (along_axis[0] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        lengths = (positions - cameras.camera_to_world[view, :, 3]).norm(dim=-1)[visible]
        index = (row * width + column)[visible]
        nearest = torch.full((height * width,), torch.inf).scatter_reduce(0, index, lengths, "amin")
        depths[view] = torch.where(nearest.isfinite(), nearest, 0.0).view(height, width, 1)
    return depths


def _read(file: Path) -> Float[np.ndarray, "H W"]:
    if file.suffix.lower() == ".npy":
        with reading(file, "depths ", advice="write a NumPy array [H, W]"):
            levels = np.load(file, allow_pickle=False)
    else:
        levels = read_levels(file)
    levels = levels[..., 0] if levels.ndim == 3 and levels.shape[-1] == 1 else levels
    if levels.ndim != 2 or levels.dtype.kind not in "uif":
        raise NerfroError(f"depths {file} have the shape {list(levels.shape)}; write one number for each pixel, [H, W]")
    return levels.astype(np.float64)
