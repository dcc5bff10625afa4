"""How well a surface's silhouettes are the masks: printed, and written as figures and as a sheet of pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.capture.overlays import contact_sheet
from nerfro.capture.pose_conventions import GOOD_OVERLAP, better_wrong_masks, overlap
from nerfro.capture.visual_hull import Silhouettes
from nerfro.cli import warn
from nerfro.data.base import Views
from nerfro.errors import first_of
from nerfro.files.atomic import write_atomically
from nerfro.files.images import save_picture
from nerfro.geometry.mesh import TriangleMesh

SHEET, REPORT = "overlays.png", "overlaps.json"
_MAX_PIXELS = 256


def settled_wrong_masks(silhouettes: Silhouettes, wrong_masks: int | None) -> int:
    """How many views may be wrong: as it is said, or that with which the hull looks most like the masks; printed."""
    if wrong_masks is None:
        wrong_masks = better_wrong_masks(silhouettes, 0) or 0
        print(f"wrong_masks={wrong_masks}: a coarse hull looks most like the masks if so many views may be wrong")
    return wrong_masks


def report_overlaps(
    split: str,
    views: Views,
    mesh: TriangleMesh,
    silhouettes: Silhouettes,
    wrong_masks: int | None,
    folder: Path,
    list_all: bool = True,
) -> Float[np.ndarray, "V"]:
    """Print, write and return how well a surface's silhouettes are the masks.

    Args:
        split: of the views.
        views: with their masks.
        mesh: the surface.
        silhouettes: of the masks.
        wrong_masks: with which the surface was carved; None for one that was not.
        folder: to write to.
        list_all: whether the overlap of every view is printed.
    """
    overlaps = overlap(mesh, silhouettes, _MAX_PIXELS)
    print("overlap (intersection over union) of the surface's silhouette with each mask:")
    for name, value in zip(views.names, overlaps, strict=True) if list_all else ():
        print(f"  {value:.4f}  {name}")
    worst = int(overlaps.argmin())
    print(f"  {overlaps.mean():.4f}  mean; {overlaps[worst]:.4f} lowest, {views.names[worst]}")
    _warn_of_bad(overlaps, views.names, silhouettes, wrong_masks)
    draw_overlays(views, mesh, overlaps, [], folder)
    each = dict(zip(views.names, (round(float(x), 4) for x in overlaps), strict=True))
    figures = {"split": split, "mean": round(float(overlaps.mean()), 4), "views": each}
    write_atomically(folder / REPORT, json.dumps(figures, indent=1) + "\n")
    return overlaps


def draw_overlays(
    views: Views, mesh: TriangleMesh, overlaps: Float[np.ndarray, "V"], inside: list[TriangleMesh], folder: Path
) -> None:
    """Write the sheet of pictures, with the outlines of what is inside, see `contact_sheet`."""
    save_picture(folder / SHEET, contact_sheet(views, mesh, overlaps, _MAX_PIXELS, inside))


def _warn_of_bad(
    overlaps: Float[np.ndarray, "V"], names: list[str], silhouettes: Silhouettes, wrong_masks: int | None
) -> None:
    bad = [names[view] for view in np.argsort(overlaps, kind="stable") if overlaps[view] < GOOD_OVERLAP]
    if not bad:
        return
    better = None if wrong_masks is None else better_wrong_masks(silhouettes, wrong_masks)
    advice = (
        "" if better is None else f"; where few masks are wrong, the others make a better hull: wrong_masks={better}"
    )
    warn(f"overlaps below {GOOD_OVERLAP}: {first_of(bad)}; look at {SHEET}, and correct their masks or poses{advice}")
