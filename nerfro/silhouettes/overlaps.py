"""Overlap of the silhouettes of a surface with the masks, as printed report, JSON file and contact sheet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import first_of, warn
from nerfro.data.base import Views
from nerfro.files.atomic import write_atomically
from nerfro.files.drawing import sheet
from nerfro.files.images import save_image
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.pose_conventions import GOOD_OVERLAP, OVERLAP_PIXELS, better_wrong_masks, overlap
from nerfro.silhouettes.silhouettes import mesh_silhouettes, pixel_stride
from nerfro.silhouettes.visual_hull import Silhouettes

SHEET, REPORT = "overlays.png", "overlaps.json"
_BOTH, _MASK_ONLY, _SURFACE_ONLY = (60, 190, 90), (235, 60, 45), (40, 110, 240)


def choose_wrong_masks(silhouettes: Silhouettes, wrong_masks: int | None) -> int:
    """Return the given number of views that may be wrong, or else the number for which the hull agrees best."""
    if wrong_masks is None:
        wrong_masks = better_wrong_masks(silhouettes, 0) or 0
        print(f"wrong_masks={wrong_masks}: with this number, a coarse hull agrees best with the masks")
    return wrong_masks


def report_overlaps(
    views: Views,
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    wrong_masks: int | None,
    folder: Path,
    list_all: bool = True,
) -> None:
    """Print and write the overlap of the silhouettes of a surface with the masks.

    Args:
        views: views with masks.
        mesh: surface.
        silhouettes: silhouettes of the masks.
        wrong_masks: number of views that may be wrong in the visual hull; None for a surface of another origin.
        folder: output folder.
        list_all: print the overlap of every view.
    """
    overlaps = overlap(mesh, silhouettes)
    print("overlap (intersection over union) of the silhouettes of the surface and the masks:")
    for name, value in sorted(zip(views.names, overlaps, strict=True)) if list_all else ():
        print(f"  {value:.4f}  {name}")
    worst = int(overlaps.argmin())
    print(f"  {overlaps.mean():.4f}  mean; {overlaps[worst]:.4f} lowest, {views.names[worst]}")
    _warn_of_bad(overlaps, views.names, silhouettes, wrong_masks)
    _draw_overlays(views, mesh, overlaps, folder)
    by_view = dict(zip(views.names, (round(float(x), 4) for x in overlaps), strict=True))
    figures = {"mean": round(float(overlaps.mean()), 4), "views": by_view}
    write_atomically(folder / REPORT, json.dumps(figures, indent=1) + "\n")


def _warn_of_bad(
    overlaps: Float[np.ndarray, "V"], names: list[str], silhouettes: Silhouettes, wrong_masks: int | None
) -> None:
    bad = [names[view] for view in np.argsort(overlaps, kind="stable") if overlaps[view] < GOOD_OVERLAP]
    if not bad:
        return
    better = None if wrong_masks is None else better_wrong_masks(silhouettes, wrong_masks)
    advice = "" if better is None else f"; or set wrong_masks={better}, which ignores as many masks and agrees better"
    warn(
        f"overlap below {GOOD_OVERLAP}: {first_of(bad)}; look at {SHEET}, and correct the masks or poses of these "
        f"views, except where another object hides a body of revolution{advice}"
    )


def _draw_overlays(views: Views, mesh: TriangleMesh, overlaps: Float[np.ndarray, "V"], folder: Path) -> None:
    """Write a contact sheet of the 48 views with the smallest overlap, the worst first.

    Green pixels belong to mask and silhouette, red ones to the mask alone, blue ones to the silhouette alone.
    """
    assert views.masks is not None
    stride = pixel_stride(views.cameras, OVERLAP_PIXELS)
    worst = np.argsort(overlaps, kind="stable")[:48].tolist()
    pictures, captions = [], []
    cameras = views.cameras.select(worst)
    for view, ours in zip(worst, mesh_silhouettes(mesh, cameras, stride), strict=True):
        theirs = views.masks[view][::stride, ::stride] > 0.5
        pictures.append(_tinted(views.images[view][::stride, ::stride], ours, theirs))
        captions.append(f"{overlaps[view]:.3f}  {views.names[view]}")
    legend = f"green: both, red: mask only, blue: surface only; worst {len(worst)} of {len(views)} views"
    save_image(folder / SHEET, sheet(pictures, captions, 192, 8, legend))


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
