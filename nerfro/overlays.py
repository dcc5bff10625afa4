"""A sheet of all views with the silhouette of a surface drawn over the mask."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfro.data.base import Views
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.silhouettes import mesh_silhouette

MAX_VIEWS = 48
_COLUMNS = 8
_WIDTH = 192  # pixels across each picture
_GAP, _LINE = 6, 20  # pixels
_PAPER, _INK = (255, 255, 255), (25, 25, 25)
MASK_ONLY, SURFACE_ONLY = (235, 60, 45), (40, 110, 240)
_BOTH = (60, 190, 90)


def contact_sheet(
    views: Views, mesh: TriangleMesh, overlaps: Float[np.ndarray, "V"], max_pixels: int
) -> Float[Tensor, "H W 3"]:
    """Pictures with what mask and surface cover: both green, the mask alone red, the surface alone blue.

    Args:
        views: with masks.
        mesh: the surface, world units.
        overlaps: of each view; the worst `MAX_VIEWS` are shown, the worst first.
        max_pixels: larger images are shown in every second, third, ... pixel.

    Returns:
        sRGB in [0, 1].
    """
    assert views.masks is not None
    stride = -(-max(views.cameras.width, views.cameras.height) // max_pixels)
    intersector = MeshIntersector([mesh], crease_degrees=30.0)
    chosen = np.argsort(overlaps, kind="stable")[:MAX_VIEWS]
    height = round(_WIDTH * views.cameras.height / views.cameras.width)
    columns = min(_COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    sheet = Image.new(
        "RGB", (columns * (_WIDTH + _GAP) + _GAP, (rows * (height + _LINE + _GAP)) + _LINE + _GAP), _PAPER
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    legend = (
        f"green: mask and surface, red: mask only, blue: surface only; {len(chosen)} of {len(views)} views, worst first"
    )
    draw.text((_GAP, 4), legend, _INK, font)
    for place, view in enumerate(chosen.tolist()):
        ours = mesh_silhouette(intersector, views.cameras, view, stride)
        theirs = views.masks[view, ::stride, ::stride] > 0.5
        picture = _tinted(views.images[view, ::stride, ::stride], ours, theirs)
        tile = Image.fromarray(np.uint8(np.rint(255 * picture.numpy()))).resize(
            (_WIDTH, height), Image.Resampling.NEAREST
        )
        left = _GAP + place % columns * (_WIDTH + _GAP)
        top = _LINE + _GAP + place // columns * (height + _LINE + _GAP)
        sheet.paste(tile, (left, top))
        draw.text((left, top + height + 2), f"{overlaps[view]:.3f}  {views.names[view][-20:]}", _INK, font)
    return torch.from_numpy(np.array(sheet)).float() / 255


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
