"""From silhouettes to a surface: carving of the visual hull, and fit of a smooth surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.progress import fraction_bar
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.base import Views
from nerfro.geometry.mesh import TriangleMesh, num_decimals
from nerfro.silhouettes.agreement import overlap
from nerfro.silhouettes.revolution import RevolutionSettings, Symmetry, fit_revolution
from nerfro.silhouettes.silhouette_fit import FitSettings, fit_surface
from nerfro.silhouettes.silhouettes import border_pixels
from nerfro.silhouettes.visual_hull import (
    HullSettings,
    Silhouettes,
    carve_grid,
    extract_surface,
    find_box,
    reaches_border,
    remove_strays,
    require_hull,
)

_MIN_VIEWS, _FEW_VIEWS = 3, 12


@dataclass(frozen=True)
class SurfaceSettings(AlgorithmSettings):
    """Settings of the surface from masks (`make_mesh`).

    Attributes:
        coarse_voxels: number of voxels along the longest side of the hull that determines the box of the object.
        box_factors: factors by which the initial box is enlarged if it cuts the hull: wrong masks shift the estimated
            centre.
        margin_voxels: margin of the object's box, in coarse voxels.
        max_loss_axis, max_loss_auto: largest decrease of the overlap with the masks for which `symmetry=axis` and
            `symmetry=auto` prefer a body of revolution, because a free surface is rough and follows errors of masks.
        one_side: angle in degrees; cameras within it see the object from one side.
        hull, fit, revolution: settings of the visual hull, of the smooth fit, and of the body of revolution.
    """

    coarse_voxels: int = 64
    box_factors: tuple[float, ...] = (1.0, 1.3, 1.7)
    margin_voxels: int = 2
    max_loss_axis: float = 0.01
    max_loss_auto: float = 0.005
    one_side: float = 75.0
    hull: HullSettings = field(default=HullSettings(), repr=False)
    fit: FitSettings = field(default=FitSettings(), repr=False)
    revolution: RevolutionSettings = field(default=RevolutionSettings(), repr=False)


def read_silhouettes(views: Views, is_bounded: bool) -> Silhouettes:
    """Check the masks of views and compute their outlines.

    Args:
        views: views with masks.
        is_bounded: whether the user gives a box or a mesh, which bounds the object where the image border cuts masks.

    Raises:
        NerfroError: masks are missing, empty, full, inverted, too few, or all cut by the image border.
    """
    if views.masks is None:
        raise NerfroError(
            "the data set has no masks, and the visual hull needs masks; docs/guides/masks.md explains where to put "
            "masks and how to make them"
        )
    masks = torch.stack(list(views.masks))
    coverage = (masks > 0.5).flatten(1).float().mean(1)
    for wrong, state in ((coverage == 0, "empty"), (coverage == 1, "full")):
        if wrong.any():
            raise NerfroError(
                f"{_names(views, wrong)}: the mask is {state}; draw the object white and everything else black, "
                "choose its labels with data.mask_labels, or remove the view"
            )
    inverted = (border_pixels(masks).float().mean(1) > 0.9) & (coverage < 1)
    if inverted.float().mean() > 0.5:
        raise NerfroError(
            f"{int(inverted.sum())} of {len(views)} masks are inverted: white along the image border, and black "
            "inside; save masks with the object white and everything else black"
        )
    if len(views) < _MIN_VIEWS:
        raise NerfroError(
            f"{len(views)} views do not determine a shape; give masks of at least {_MIN_VIEWS} views, better of 30 "
            "from all sides"
        )
    if len(views) < _FEW_VIEWS:
        warn(f"{len(views)} views give a coarse visual hull; 30 views from all sides are better")
    silhouettes = Silhouettes.of(views.cameras, masks)
    if silhouettes.cut.all() and not is_bounded:
        raise NerfroError(
            f"the image border cuts the object in all {len(views)} views, so no outline is complete; photograph the "
            "object from farther away, or give box_min= and box_max= to bound the hull"
        )
    if silhouettes.cut.any():
        warn(
            f"{_names(views, silhouettes.cut)}: the image border cuts the object; the surface outside the image is "
            "unknown"
        )
    return silhouettes


def make_mesh(
    silhouettes: Silhouettes,
    corners: Float[np.ndarray, "2 3"] | None,
    resolution: int,
    wrong_masks: int,
    keep: int | None,
    smoothing: float,
    symmetry: Symmetry | None = None,
    evidence: Silhouettes | None = None,
    is_revolution: bool = False,
    settings: SurfaceSettings = SurfaceSettings(),
) -> TriangleMesh:
    """Carve the visual hull and fit a smooth surface.

    Args:
        silhouettes: silhouettes of the object.
        corners: box of the hull; None estimates the box.
        resolution: number of voxels along the longest side.
        wrong_masks: number of views that may be wrong about any point.
        keep: number of components to keep; None keeps all but small ones.
        smoothing: factor of the estimated smoothing strength; 0 returns the hull itself.
        symmetry: also fit a body of revolution, which is used unless its overlap with the masks is smaller by more
            than 0.005 (`auto`) or 0.01 (`axis`, with a warning).
        evidence: silhouettes that decide between the two surfaces; by default all.
        is_revolution: whether silhouettes are projections of a body of revolution, so that a free surface is only
            fitted if the hull has no axis.
        settings: settings of hull and fits.

    Raises:
        NerfroError: the hull is empty, no view sees the surface, or the hull has no axis for `symmetry=axis`.
    """
    settings.use()
    box = _object_box(silhouettes, wrong_masks, keep, settings) if corners is None else corners
    with fraction_bar("carving") as progress:
        distances, spacing = carve_grid(silhouettes, box, resolution, wrong_masks, progress, settings.hull)
    num_parts, num_kept = remove_strays(distances, keep)
    mesh, revolution = extract_surface(distances, box[0], spacing), None
    if symmetry is not None and is_revolution:
        revolution = fit_revolution(mesh, silhouettes, settings=settings.revolution)
    if revolution is None and smoothing > 0:
        mesh = fit_surface(mesh, silhouettes, smoothing, settings.fit)
    if revolution is not None:
        mesh = revolution
    elif symmetry is not None:
        revolution = fit_revolution(mesh, silhouettes, settings=settings.revolution)
        mesh = _choose_symmetry(revolution, mesh, evidence or silhouettes, symmetry, settings)
    if num_kept < num_parts:
        print(f"kept the largest {num_kept} of {num_parts} separate components")
    if reaches_border(distances):
        _warn_of_open_hull(silhouettes, box, settings.one_side)
    print(f"{len(mesh.faces)} triangles, voxels of {spacing:.4g}")
    return mesh


def _choose_symmetry(
    revolution: TriangleMesh | None,
    free: TriangleMesh,
    silhouettes: Silhouettes,
    symmetry: Symmetry,
    settings: SurfaceSettings,
) -> TriangleMesh:
    """Choose the body of revolution unless its overlap with the masks is smaller by more than the limit of `symmetry`.

    The medians are compared, because a foreground object may be cut out of some masks.
    """
    if revolution is None:
        if symmetry == "axis":
            raise NerfroError("symmetry=axis is not possible, because the visual hull has no axis; remove the option")
        return free
    max_loss = {"axis": settings.max_loss_axis, "auto": settings.max_loss_auto}[symmetry]
    symmetric, unconstrained = (float(np.median(overlap(mesh, silhouettes))) for mesh in (revolution, free))
    result = f"median overlap with the masks: {symmetric:.4f} as a body of revolution, {unconstrained:.4f} otherwise"
    if symmetry == "axis" and symmetric < unconstrained - max_loss:
        warn(f"{result}; the object is no body of revolution, and symmetry=axis is ignored")
        return free
    print(result)
    return revolution if symmetric >= unconstrained - max_loss else free


def _object_box(
    silhouettes: Silhouettes, wrong_masks: int, keep: int | None, settings: SurfaceSettings
) -> Float[np.ndarray, "2 3"]:
    """Estimate the bounding box of the object, with a margin, from a coarse visual hull.

    A box that cuts the hull is enlarged; if no enlargement contains the hull, the initial box is used.
    """
    initial = find_box(silhouettes, wrong_masks)
    for factor in (*settings.box_factors, 1.0):
        box = initial.mean(0) + factor * (initial - initial.mean(0))
        distances, spacing = carve_grid(silhouettes, box, settings.coarse_voxels, wrong_masks, settings=settings.hull)
        remove_strays(distances, keep)
        if not reaches_border(distances):
            break
    require_hull(distances)
    inside = np.argwhere(distances < 0)
    low, high = inside.min(0) - settings.margin_voxels, inside.max(0) + settings.margin_voxels
    return (box[0] + spacing * np.stack([low, high])).clip(*box)


def _warn_of_open_hull(silhouettes: Silhouettes, box: Float[np.ndarray, "2 3"], one_side: float) -> None:
    towards = silhouettes.cameras.camera_to_world[:, :, 3] - torch.from_numpy(box.mean(0)).float()
    towards = torch.nn.functional.normalize(towards, dim=-1)
    spread = float(torch.rad2deg(torch.arccos((towards @ towards.T).clamp(-1, 1))).max())
    if spread < one_side:
        reason = f"all cameras look from within {spread:.0f} degrees, so silhouettes do not bound the object in depth"
    else:
        reason = "the image border cuts the masks that would bound the hull, or the box is too small"
    corners = np.round(box, num_decimals(float(np.ptp(box, axis=0).max()), 4)).tolist()
    warn(f"the box {corners} cuts the visual hull: {reason}; set the box with box_min= and box_max=")


def _names(views: Views, is_named: torch.Tensor) -> str:
    return first_of([name for name, named in zip(views.names, is_named.tolist(), strict=True) if named])
