"""Alignment of the training cameras to the outlines of masks."""

from __future__ import annotations

import torch

from nerfro.camera.least_squares import PriorInformation
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.capture.outlines import align_to_outlines
from nerfro.capture.silhouettes import PixelBlocks
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid

# Largest side of the reduced images in which outlines are compared, pixels.
_MAX_PIXELS = 256


def align_to_masks(
    camera: RefinedCamera, views: Views, medium: Medium, panorama: PriorInformation | None
) -> PriorInformation | None:
    """Move cameras so that the outlines of the surface agree with the masks.

    Args:
        camera: estimated cameras; they are changed.
        views: training views.
        medium: medium with the surface.
        panorama: prior of the camera rotations from the background; None without a panorama.

    Returns:
        Prior of the cameras from the outlines; None without masks or without a surface.
    """
    if not isinstance(medium, SdfGrid) or not medium.meshes or (silhouettes := mask_silhouettes(views)) is None:
        return None
    priors = [] if panorama is None else [panorama]
    return align_to_outlines(camera, views.cameras, reduced, silhouettes, medium.meshes[0], priors)


def mask_silhouettes(views: Views) -> Silhouettes | None:
    """Reduce the masks of all views; None without masks."""
    if views.masks is None:
        return None
    blocks = PixelBlocks(views.cameras, _MAX_PIXELS)
    return Silhouettes.of(blocks.cameras(views.cameras), torch.stack([blocks.mean(mask) for mask in views.masks]))


def reduced(cameras: Cameras) -> Cameras:
    """Return the cameras of the reduced images."""
    return PixelBlocks(cameras, _MAX_PIXELS).cameras(cameras)
