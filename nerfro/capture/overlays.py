"""A sheet of all views with the silhouette of a surface drawn over the mask."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerfro.capture.silhouettes import mesh_silhouettes, pixel_stride
from nerfro.data.base import Views
from nerfro.files.drawing import sheet
from nerfro.geometry.mesh import TriangleMesh

_MAX_VIEWS, _COLUMNS = 48, 8
_WIDTH = 192  # pixels across each picture
_NAME_LENGTH = 16  # characters, the last ones, that fit below a picture
_BOTH, _MASK_ONLY, _SURFACE_ONLY = (60, 190, 90), (235, 60, 45), (40, 110, 240)


def contact_sheet(views: Views, mesh: TriangleMesh, overlaps: Float[np.ndarray, "V"], max_pixels: int) -> Image.Image:
    """The views that overlap least, the worst first: both green, the mask alone red, the surface alone blue.

    Images of more than `max_pixels` a side are shown in every second, third, ... pixel.
    """
    assert views.masks is not None
    stride = pixel_stride(views.cameras, max_pixels)
    chosen = np.argsort(overlaps, kind="stable")[:_MAX_VIEWS].tolist()
    pictures, captions = [], []
    for view, ours in zip(chosen, mesh_silhouettes(mesh, views.cameras.select(chosen), stride), strict=True):
        theirs = views.masks[view][::stride, ::stride] > 0.5
        pictures.append(_tinted(views.images[view][::stride, ::stride], ours, theirs))
        captions.append(f"{overlaps[view]:.3f}  {views.names[view][-_NAME_LENGTH:]}")
    legend = f"green: both, red: mask only, blue: surface only; worst {len(chosen)} of {len(views)} views"
    return sheet(pictures, captions, _WIDTH, _COLUMNS, legend)


def _tinted(image: Tensor, ours: Tensor, theirs: Tensor) -> Tensor:
    grey = image.mean(-1, keepdim=True).expand(*image.shape)
    picture = grey.clone()
    for where, colour, strength in (
        (ours & theirs, _BOTH, 0.35),
        (theirs & ~ours, _MASK_ONLY, 0.85),
        (ours & ~theirs, _SURFACE_ONLY, 0.85),
    ):
        picture[where] = (1 - strength) * grey[where] + strength * torch.tensor(colour) / 255
    return picture.clamp(0, 1)
