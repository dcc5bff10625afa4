"""What the photographs' outlines tell of a surface that learns, and of the cameras."""

from __future__ import annotations

import torch

from nerfro.camera.least_squares import PriorInformation
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.capture.outlines import meet_outlines
from nerfro.capture.pixel_blocks import PixelBlocks
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid

# Outlines are looked at in pictures of at most so many pixels a side; one is known to about this, pixels.
_MAX_PIXELS, _KNOWN = 256, 0.25


def meet_masks(
    camera: RefinedCamera, views: Views, medium: Medium, panorama: PriorInformation | None
) -> PriorInformation | None:
    """Move cameras until the surface is seen in its masks; what these tell, or none where one of both is missing.

    Args:
        camera: what is believed of the cameras; it is changed.
        views: of them.
        medium: that has the surface.
        panorama: what the sky tells.
    """
    if not isinstance(medium, SdfGrid) or not medium.meshes or (silhouettes := mask_silhouettes(views)) is None:
        return None
    told = [] if panorama is None else [panorama]
    return meet_outlines(camera, views.cameras, reduced, silhouettes, medium.meshes[0], told)


def mask_silhouettes(views: Views) -> Silhouettes | None:
    """What the masks of all views say, in smaller pictures; None where there are none."""
    if views.masks is None:
        return None
    blocks = PixelBlocks(views.cameras, _MAX_PIXELS)
    return Silhouettes.of(blocks.cameras(views.cameras), torch.stack([blocks.mean(mask) for mask in views.masks]))


def reduced(cameras: Cameras) -> Cameras:
    """Cameras of those smaller pictures."""
    return PixelBlocks(cameras, _MAX_PIXELS).cameras(cameras)
