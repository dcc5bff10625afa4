"""Agreement of surfaces and poses with the masks, which also detects misread pose conventions; reports of overlaps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError, first_of, warn
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.base import Views
from nerfro.files.atomic import write_json
from nerfro.files.images import save_image, sheet
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.silhouettes import intersection_over_union, mesh_silhouettes, pixel_stride
from nerfro.silhouettes.visual_hull import Silhouettes, carve_mesh, find_box

# The silhouettes of a visual hull agree with its masks; a smaller overlap or agreement indicates an error in the input.
GOOD_OVERLAP = 0.9
OVERLAP_PIXELS = 256  # per side, for overlaps; larger masks are subsampled
SHEET, REPORT = "overlays.png", "overlaps.json"
_BOTH, _MASK_ONLY, _SURFACE_ONLY = (60, 190, 90), (235, 60, 45), (40, 110, 240)


@dataclass(frozen=True)
class AgreementSettings(AlgorithmSettings):
    """Settings of the comparison of masks with their coarse visual hull (`coarse_agreement`).

    Attributes:
        voxels: number of voxels per side of the hull.
        pixels: largest number of pixels per side of the masks.
        slack: tolerance at outlines, in pixels of the downscaled masks.
    """

    voxels: int = 48
    pixels: int = 64
    slack: float = 1.5


# Alternative conventions of the poses in a file, with the correction of each, the most frequent mistakes first.
# `_Turn` is applied to the camera axes (x right, y up, z back), after the inversion of the matrix if the flag is set.
_Turn = tuple[tuple[int, int, int], ...]
_HALF_TURN = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
_FLIP = "the camera's y and z axes flipped (OpenCV's axes, y down, z forward, in a file read as OpenGL's, or reversed)"
_INVERTED_FLIP = "the matrices inverted and the y and z axes flipped (world-to-camera matrices in OpenCV's axes)"
_ALTERNATIVES: tuple[tuple[str, bool, _Turn], ...] = (
    (_FLIP, False, _HALF_TURN),
    ("the matrices inverted (they are world-to-camera)", True, ((1, 0, 0), (0, 1, 0), (0, 0, 1))),
    (_INVERTED_FLIP, True, _HALF_TURN),
    ("y flipped (images and masks are upside down, or y points down)", False, ((1, 0, 0), (0, -1, 0), (0, 0, 1))),
    ("x flipped (images and masks are mirrored)", False, ((-1, 0, 0), (0, 1, 0), (0, 0, 1))),
    ("x and y flipped (images turned by 180 degrees)", False, ((-1, 0, 0), (0, -1, 0), (0, 0, 1))),
    ("x and y exchanged (LLFF's axes: down, right, back)", False, ((0, -1, 0), (1, 0, 0), (0, 0, 1))),
    ("z flipped (cameras that look along +z, y up)", False, ((1, 0, 0), (0, 1, 0), (0, 0, -1))),
)


def overlap(mesh: TriangleMesh, silhouettes: Silhouettes, max_pixels: int = OVERLAP_PIXELS) -> Float[np.ndarray, "V"]:
    """Compute the intersection over union of the silhouette of a mesh with each mask; 1 where both are empty."""
    stride = pixel_stride(silhouettes.cameras, max_pixels)
    theirs = silhouettes.masks[:, ::stride, ::stride] > 0.5
    return intersection_over_union(mesh_silhouettes(mesh, silhouettes.cameras, stride).numpy(), theirs.numpy())


def coarse_agreement(
    silhouettes: Silhouettes, wrong_masks: int = 0, settings: AgreementSettings = AgreementSettings()
) -> Float[np.ndarray, "V"]:
    """Compute the agreement of a coarse visual hull with each mask.

    The agreement is 1 minus the number of differing pixels that are not near the outline, relative to the area of the
    mask, clamped at 0. The agreement with an empty hull is 0.
    """
    settings.use()
    hull = carve_mesh(silhouettes, find_box(silhouettes, wrong_masks), settings.voxels, wrong_masks)
    if hull is None:
        return np.zeros(len(silhouettes))
    stride = pixel_stride(silhouettes.cameras, settings.pixels)
    ours = mesh_silhouettes(hull, silhouettes.cameras, stride)
    outlines = silhouettes.distances[:, ::stride, ::stride]
    differs = (ours != (outlines > 0)) & (outlines.abs() > settings.slack * stride)
    return (1 - differs.sum((1, 2)).double() / (outlines > 0).sum((1, 2)).clamp(min=1)).clamp(min=0).numpy()


def require_consistent_poses(silhouettes: Silhouettes, names: list[str], wrong_masks: int) -> None:
    """Check that the visual hull of the masks agrees with the masks.

    Raises:
        NerfroError: it does not; the message names the misread pose convention or the inconsistent views, if found.
    """
    agreement = float(np.median(coarse_agreement(silhouettes, wrong_masks)))
    if agreement >= GOOD_OVERLAP:
        return
    state = f"the visual hull agrees with the masks only to {agreement:.0%}"
    state = "the visual hull is empty: no point lies inside all masks" if agreement == 0 else state
    scores = [float(np.median(coarse_agreement(_changed(silhouettes, i, t), wrong_masks))) for _, i, t in _ALTERNATIVES]
    # Symmetric objects agree equally well with several conventions; the first of the list is the most frequent mistake.
    best = next(i for i, score in enumerate(scores) if score >= max(scores) - 0.002)
    if scores[best] > max(GOOD_OVERLAP, agreement):
        raise NerfroError(
            f"{state}; the poses use another convention: with {_ALTERNATIVES[best][0]} the agreement is "
            f"{scores[best]:.0%}; correct transform_matrix, or choose the matching data= format"
        )
    for allowed in _numbers_of_wrong_masks(len(names), wrong_masks):
        agreements = coarse_agreement(silhouettes, allowed)
        if np.median(agreements) >= GOOD_OVERLAP:
            worst = [names[view] for view in np.argsort(agreements, kind="stable")[:allowed]]
            raise NerfroError(
                f"{state}, but agrees if {allowed} views may be wrong; check the masks and poses of "
                f"{', '.join(worst)}, and correct these views or set wrong_masks={allowed}"
            )
    raise NerfroError(
        f"{state}, and none of the known pose conventions explains the difference; check that masks, images and poses "
        "belong together and that the object did not move between the views"
    )


def better_wrong_masks(silhouettes: Silhouettes, wrong_masks: int) -> int | None:
    """Find the number of wrong views for which a coarse hull agrees best; None if no number is better by 0.005."""
    min_gain = 0.005
    tried = [wrong_masks, *_numbers_of_wrong_masks(len(silhouettes), wrong_masks)]
    agreements = [float(coarse_agreement(silhouettes, allowed).mean()) for allowed in tried]
    best = next(i for i, agreement in enumerate(agreements) if agreement >= max(agreements) - min_gain)
    return tried[best] if agreements[best] > agreements[0] + min_gain else None


def _numbers_of_wrong_masks(num_views: int, more_than: int) -> list[int]:
    """Return candidates 1, 2, 4, ... up to the largest number of wrong views that the other views outvote."""
    most = max(1, num_views // 6)
    return [number for number in sorted({2**power for power in range(8)} | {most}) if more_than < number <= most]


def _changed(silhouettes: Silhouettes, inverse: bool, turn: _Turn) -> Silhouettes:
    """Reinterpret the poses by another convention."""
    poses: Tensor = silhouettes.cameras.camera_to_world
    rotation, centre = poses[:, :, :3], poses[:, :, 3:]
    if inverse:
        rotation = rotation.transpose(1, 2)
        centre = -rotation @ centre
    poses = torch.cat([rotation @ torch.tensor(turn, dtype=rotation.dtype), centre], -1)
    return replace(silhouettes, cameras=replace(silhouettes.cameras, camera_to_world=poses))


def choose_wrong_masks(silhouettes: Silhouettes, wrong_masks: int | None) -> int:
    """Return the given number of views that may be wrong, or else the number for which the hull agrees best.

    Raises:
        NerfroError: fewer than two views would have to be right.
    """
    most = max(0, len(silhouettes) - 2)
    if wrong_masks is not None and wrong_masks > most:
        raise NerfroError(
            f"wrong_masks={wrong_masks} is not allowed: two of the {len(silhouettes)} views must be right; give at "
            f"most {most}, better a sixth of the views"
        )
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
    write_json(folder / REPORT, figures)


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
