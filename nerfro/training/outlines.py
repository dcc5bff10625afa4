"""What the photographs' outlines tell of a surface that learns."""

from __future__ import annotations

import torch

from nerfro.cameras import Window
from nerfro.capture.silhouette_fit import rim_points
from nerfro.capture.silhouettes import mesh_silhouettes, pixel_stride
from nerfro.capture.visual_hull import Silhouettes
from nerfro.data.base import Views
from nerfro.data.masks import masked_views
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid

# Outlines are looked at in pictures of at most so many pixels a side; one is known to about this, pixels.
_MAX_PIXELS, _KNOWN = 256, 0.25


@torch.no_grad()
def hold_outlines(medium: Medium, views: Views) -> None:
    """Tell a surface that learns where views see its outlines: it shall meet those of the masks there.

    Where there are no masks, the outlines that the surface was given are right, and stay.
    """
    if not medium.surface_parameters():
        return
    assert isinstance(medium, SdfGrid)
    views, mesh = masked_views(views), medium.meshes[0]
    stride = pixel_stride(views.cameras, _MAX_PIXELS)
    height, width = views.cameras.height // stride, views.cameras.width // stride
    window = Window(0, 0, height * stride, width * stride)
    cameras = views.cameras.crop(window).resized(width, height)
    if views.masks is None:
        masks = mesh_silhouettes(mesh, cameras, 1).float()
    else:
        cut = (window.cut(mask.float()[None]) for mask in views.masks)
        masks = torch.stack([mask.view(height, stride, width, stride).mean((1, 3)) for mask in cut])
    places, outwards, width_of_pixel = rim_points(mesh, Silhouettes.of(cameras, masks))
    if views.masks is None:
        outwards = torch.zeros_like(outwards)
    if len(places):
        medium.hold(places, outwards, _KNOWN * float(width_of_pixel.mean()))
