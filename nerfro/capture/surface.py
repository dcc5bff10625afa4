"""From silhouettes to a surface: the hull is carved, and a smooth surface fitted into it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from nerfro.capture.pose_conventions import overlap
from nerfro.capture.revolution import Symmetry, fit_revolution
from nerfro.capture.silhouette_fit import fit_surface
from nerfro.capture.silhouettes import frame_pixels
from nerfro.capture.visual_hull import Silhouettes, carve_grid, extract_surface, find_box, reaches_border, remove_strays
from nerfro.cli import warn
from nerfro.data.base import Views
from nerfro.errors import NerfroError, first_of
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid

_FEWEST_VIEWS, _FEW_VIEWS = 3, 12
_COARSE_VOXELS = 64
# Masks that are wrong shift the place where all seem to meet, so boxes so much wider are tried.
_WIDER = (1.0, 1.3, 1.7)
# The object's box is found to this many coarse voxels.
_MARGIN_VOXELS = 2
# Of a body of revolution, which is truer where nothing tells, so much less overlap is taken; pixels a side to see it.
_LESS_ALIKE, _MAX_PIXELS = 0.01, 256
# Cameras whose directions to the object lie within this angle see it from one side, degrees.
_ONE_SIDE = 75.0


def read_silhouettes(views: Views, has_box: bool) -> Silhouettes:
    """The outlines of views, checked; a box that the user has given bounds what the masks do not."""
    if views.masks is None:
        raise NerfroError(
            "the data has no masks, and the hull is made of them; docs/capture.md tells where they are looked for "
            "and how to make them"
        )
    masks = torch.stack(list(views.masks))
    share = (masks > 0.5).flatten(1).float().mean(1)
    for wrong, what in ((share == 0, "empty"), (share == 1, "all object")):
        if wrong.any():
            raise NerfroError(
                f"{_names(views, wrong)}: the mask is {what}; draw it (object white, everything else black), "
                "or take the view out"
            )
    # The frame is object and the rest is not: true of no photograph of an object, let alone of most.
    inverted = (frame_pixels(masks).float().mean(1) > 0.9) & (share < 1)
    if inverted.float().mean() > 0.5:
        raise NerfroError(
            f"{int(inverted.sum())} of {len(views)} masks cover the frame of their image and leave the inside: "
            "they are inverted; save them with the object white and everything else black"
        )
    if len(views) < _FEWEST_VIEWS:
        raise NerfroError(
            f"{len(views)} views do not bound a shape; give masks of {_FEWEST_VIEWS} or more, better 30 from all sides"
        )
    if len(views) < _FEW_VIEWS:
        warn(f"{len(views)} views make a coarse hull; 30 from all sides make a good one")
    silhouettes = Silhouettes.of(views.cameras, masks)
    if silhouettes.cut.all() and not has_box:
        raise NerfroError(
            f"the object is cut by the frame in all {len(views)} views, so that it has no whole outline; "
            "photograph it from farther away, or give box_min= and box_max= to cut the hull there"
        )
    if silhouettes.cut.any():
        warn(f"{_names(views, silhouettes.cut)}: the frame cuts the object; nothing is known beyond it")
    return silhouettes


def make_mesh(
    silhouettes: Silhouettes,
    corners: Float[np.ndarray, "2 3"] | None,
    resolution: int,
    wrong_masks: int,
    keep: int | None,
    smoothing: float,
    symmetry: Symmetry | None = None,
) -> TriangleMesh:
    """Carve the hull and fit a smooth surface into it, see `PreprocessConfig`; the box is found where none is given.

    With `symmetry` a body of revolution is fitted too, and taken where it looks as much like the masks. For `axis`,
    which tells what the object is, it may look a little less like them.
    """
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as progress:
        box = object_box(silhouettes, wrong_masks) if corners is None else corners
        carving = progress.add_task("carving", total=3)
        distances, corner, spacing = carve_grid(
            silhouettes, box, resolution, wrong_masks, lambda done: progress.update(carving, completed=done)
        )
        num_parts, num_kept = remove_strays(distances, keep)
        mesh = extract_surface(distances, corner, spacing)
        if smoothing > 0:
            fitting = progress.add_task("fitting", total=1)
            mesh = fit_surface(mesh, silhouettes, smoothing, lambda done: progress.update(fitting, completed=done))
        if symmetry is not None:
            turning = progress.add_task("finding the axis", total=1)
            turned = fit_revolution(mesh, silhouettes, lambda done: progress.update(turning, completed=done))
    if symmetry is not None:
        mesh = _as_alike(turned, mesh, silhouettes, symmetry)
    if num_kept < num_parts:
        print(f"{num_kept} of {num_parts} separate parts kept, the largest")
    if reaches_border(distances):
        _warn_of_open_hull(silhouettes, box)
    print(f"{len(mesh.faces)} triangles, voxels of {spacing:.4g}")
    return mesh


def _as_alike(
    turned: TriangleMesh | None, free: TriangleMesh, silhouettes: Silhouettes, symmetry: Symmetry
) -> TriangleMesh:
    """The body of revolution, unless its silhouettes are less like the masks' than the free surface's.

    Medians are compared: masks from which something before the object is cut out should not decide.
    """
    if turned is None:
        if symmetry == "axis":
            raise NerfroError("symmetry=axis: the hull has no axis; leave it out")
        return free
    of_turned, of_free = (float(np.median(overlap(mesh, silhouettes, _MAX_PIXELS))) for mesh in (turned, free))
    told = f"overlap with the masks, median: {of_turned:.4f} as a body of revolution, {of_free:.4f} without"
    if symmetry == "axis" and of_turned < of_free - _LESS_ALIKE:
        warn(f"{told}; so it is none, and symmetry=axis is not used")
        return free
    print(told)
    return free if symmetry == "auto" and of_turned < of_free else turned


def surfaces_inside(medium: Medium) -> list[TriangleMesh]:
    """The surfaces of the bodies inside the outer one, as far as they are there; none of a medium without a grid."""
    if not isinstance(medium, SdfGrid):
        return []
    low, spacing = (values.double().cpu().numpy() for values in (medium.box[0], medium.spacing))
    of_bodies = medium.distances.cummax(0).values[1:].cpu().numpy()
    return [extract_surface(distances, low, spacing) for distances in of_bodies if (distances < 0).any()]


def object_box(silhouettes: Silhouettes, wrong_masks: int) -> Float[np.ndarray, "2 3"]:
    """Bounds of a coarse hull, with a margin; a box that cuts the hull off is made larger if that helps."""
    first = find_box(silhouettes, wrong_masks)
    for wider in (*_WIDER, 1.0):
        box = first.mean(0) + wider * (first - first.mean(0))
        distances, corner, spacing = carve_grid(silhouettes, box, _COARSE_VOXELS, wrong_masks)
        remove_strays(distances)
        if not reaches_border(distances):
            break
    inside = np.argwhere(distances < 0)
    low, high = inside.min(0) - _MARGIN_VOXELS, inside.max(0) + _MARGIN_VOXELS
    return np.stack([corner + spacing * low, corner + spacing * high]).clip(*box)


def _warn_of_open_hull(silhouettes: Silhouettes, box: Float[np.ndarray, "2 3"]) -> None:
    towards = silhouettes.cameras.camera_to_world[:, :, 3] - torch.from_numpy(box.mean(0)).float()
    towards = torch.nn.functional.normalize(towards, dim=-1)
    spread = float(torch.rad2deg(torch.arccos((towards @ towards.T).clamp(-1, 1))).max())
    if spread < _ONE_SIDE:
        reason = (
            f"all cameras look from within {spread:.0f} degrees, and no silhouette shows where the object ends in depth"
        )
    else:
        reason = "the masks that would bound it are cut by their frames, or the box is too small"
    warn(f"the hull is cut off by the box {np.round(box, 3).tolist()}: {reason}; give box_min= and box_max= to set it")


def _names(views: Views, chosen: torch.Tensor) -> str:
    return first_of([name for name, wanted in zip(views.names, chosen.tolist(), strict=True) if wanted])
