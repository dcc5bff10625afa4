"""A sheet of all views with the silhouette of a surface drawn over the mask."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerfro.capture.silhouettes import mesh_silhouette, pixel_stride
from nerfro.data.base import Views
from nerfro.files.drawing import sheet
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh

MAX_VIEWS = 48
_COLUMNS = 8
_WIDTH = 192  # pixels across each picture
_NAME_LENGTH = 16  # characters, the last ones, that fit below a picture
MASK_ONLY, SURFACE_ONLY = (235, 60, 45), (40, 110, 240)
_BOTH = (60, 190, 90)


def contact_sheet(views: Views, mesh: TriangleMesh, overlaps: Float[np.ndarray, "V"], max_pixels: int) -> Image.Image:
    """Pictures with what mask and surface cover: both green, the mask alone red, the surface alone blue.

    Args:
        views: with masks.
        mesh: the surface, world units.
        overlaps: of each view; the worst `MAX_VIEWS` are shown, the worst first.
        max_pixels: larger images are shown in every second, third, ... pixel.
    """
    assert views.masks is not None
    stride = pixel_stride(views.cameras, max_pixels)
    intersector = MeshIntersector(mesh.triangles)
    chosen = np.argsort(overlaps, kind="stable")[:MAX_VIEWS]
    pictures, captions = [], []
    for view in chosen.tolist():
        ours = mesh_silhouette(intersector, views.cameras, view, stride)
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
        (theirs & ~ours, MASK_ONLY, 0.85),
        (ours & ~theirs, SURFACE_ONLY, 0.85),
    ):
        picture[where] = (1 - strength) * grey[where] + strength * torch.tensor(colour) / 255
    return picture.clamp(0, 1)
