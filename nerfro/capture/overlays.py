"""Contact sheet of all views with the silhouette of a surface drawn over the mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from nerfro.capture.silhouettes import mesh_silhouettes, pixel_stride
from nerfro.data.base import Views
from nerfro.files.drawing import sheet
from nerfro.geometry.mesh import TriangleMesh

_MAX_VIEWS, _COLUMNS = 48, 8
_WIDTH = 192  # width of a tile, in pixels
_NAME_LENGTH = 16  # number of last characters of a name that fit below a tile
_BOTH, _MASK_ONLY, _SURFACE_ONLY = (60, 190, 90), (235, 60, 45), (40, 110, 240)
_OUTLINES = {"yellow": (255, 215, 0), "white": (255, 255, 255)}  # colours of the first and of further inner bodies


def contact_sheet(
    views: Views,
    mesh: TriangleMesh,
    overlaps: Float[np.ndarray, "V"],
    max_pixels: int,
    inside: Sequence[TriangleMesh] = (),
) -> Image.Image:
    """Draw the views with the smallest overlap, the worst first.

    Green pixels belong to mask and silhouette, red ones to the mask alone, blue ones to the silhouette alone.

    Args:
        views: views with masks.
        mesh: surface.
        overlaps: intersection over union by view.
        max_pixels: larger images are subsampled to at most so many pixels per side.
        inside: inner bodies, drawn as outlines.
    """
    assert views.masks is not None
    stride = pixel_stride(views.cameras, max_pixels)
    chosen = np.argsort(overlaps, kind="stable")[:_MAX_VIEWS].tolist()
    pictures, captions = [], []
    cameras = views.cameras.select(chosen)
    outlines = [_outlines(mesh_silhouettes(body, cameras, stride)) for body in inside]
    for place, (view, ours) in enumerate(zip(chosen, mesh_silhouettes(mesh, cameras, stride), strict=True)):
        theirs = views.masks[view][::stride, ::stride] > 0.5
        picture = _tinted(views.images[view][::stride, ::stride], ours, theirs)
        for body, outline in enumerate(outlines):
            picture[outline[place]] = torch.tensor(list(_OUTLINES.values())[min(body, 1)]) / 255
        pictures.append(picture)
        captions.append(f"{overlaps[view]:.3f}  {views.names[view][-_NAME_LENGTH:]}")
    colours = [f"{colour}: body {body + 2}" for body, colour in zip(range(len(inside)), _OUTLINES, strict=False)]
    legend = ", ".join(["green: both, red: mask only, blue: surface only", *colours])
    legend += f"; worst {len(chosen)} of {len(views)} views"
    return sheet(pictures, captions, _WIDTH, _COLUMNS, legend)


def _outlines(silhouettes: Bool[Tensor, "V h w"]) -> Bool[Tensor, "V h w"]:
    """Select the pixels of silhouettes that touch a pixel outside."""
    others = torch.nn.functional.max_pool2d((~silhouettes[:, None]).float(), 3, 1, 1)[:, 0]
    return silhouettes & (others > 0)


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
