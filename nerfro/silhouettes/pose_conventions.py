"""Consistency check of poses and masks, which also detects misread pose conventions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.silhouettes.silhouettes import intersection_over_union, mesh_silhouettes, pixel_stride
from nerfro.silhouettes.visual_hull import Silhouettes, carve_mesh, find_box

# The silhouettes of a visual hull agree with its masks; a smaller overlap or agreement indicates an error in the input.
GOOD_OVERLAP = 0.9
OVERLAP_PIXELS = 256  # per side, for overlaps; larger masks are subsampled


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
