"""Whether poses and masks agree, and which misread convention would explain it if they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.capture.silhouettes import mesh_silhouettes, pixel_stride
from nerfro.capture.visual_hull import Silhouettes, carve_grid, extract_surface, find_box, remove_strays
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh

# The first look is at so many voxels a side and at most so many pixels a side.
_COARSE_VOXELS, _COARSE_PIXELS = 48, 64
# A hull meets the masks that it was carved from; below this overlap, or this agreement, something is wrong.
GOOD_OVERLAP = 0.9
# A coarse hull may miss a mask's outline by this many of the pixels that it is looked at in.
_SLACK = 1.5
# One wrong view needs so many; an agreement is clearly better by this much.
_VOTES, _CLEARLY = 6, 0.005

# What a file's poses could have been, as what has to be done to them as they were read; most frequent mistakes first.
# `turn` is applied to the camera's axes (x right, y up, z back), `inverse` to the whole matrix before.
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


def overlap(mesh: TriangleMesh, silhouettes: Silhouettes, max_pixels: int) -> Float[np.ndarray, "V"]:
    """Intersection over union of a mesh's silhouette with each mask, 1 where both are empty, see `pixel_stride`."""
    stride = pixel_stride(silhouettes.cameras, max_pixels)
    ours, theirs = mesh_silhouettes(mesh, silhouettes.cameras, stride), silhouettes.masks[:, ::stride, ::stride] > 0.5
    both, either = (ours & theirs).sum((1, 2)).double(), (ours | theirs).sum((1, 2))
    return torch.where(either > 0, both / either, 1.0).numpy()


def coarse_agreement(silhouettes: Silhouettes, wrong_masks: int = 0) -> Float[np.ndarray, "V"]:
    """How well a coarse hull explains each mask: 1, less the pixels that differ and are not near the mask's outline.

    Counted in pixels of the mask; not below 0, and 0 where the hull is empty.
    """
    box = find_box(silhouettes, wrong_masks)
    distances, corner, spacing = carve_grid(silhouettes, box, _COARSE_VOXELS, wrong_masks)
    remove_strays(distances)
    if not (distances < 0).any():
        return np.zeros(len(silhouettes))
    stride = pixel_stride(silhouettes.cameras, _COARSE_PIXELS)
    ours = mesh_silhouettes(extract_surface(distances, corner, spacing), silhouettes.cameras, stride)
    outlines = silhouettes.distances[:, ::stride, ::stride]
    differs = (ours != (outlines > 0)) & (outlines.abs() > _SLACK * stride)
    return (1 - differs.sum((1, 2)).double() / (outlines > 0).sum((1, 2)).clamp(min=1)).clamp(min=0).numpy()


def require_consistent_poses(silhouettes: Silhouettes, names: list[str], wrong_masks: int) -> None:
    """Refuse masks whose common hull does not look like them; name the misread convention or the odd views."""
    found = float(np.median(coarse_agreement(silhouettes, wrong_masks)))
    if found >= GOOD_OVERLAP:
        return
    state = f"the visual hull covers the masks badly (to {found:.0%})"
    state = "the visual hull is empty: no point lies inside all masks" if found == 0 else state
    scores = [float(np.median(coarse_agreement(_changed(silhouettes, i, t), wrong_masks))) for _, i, t in _ALTERNATIVES]
    # Of equally good ones (a ball is a ball upside down) the most frequent mistake.
    best = next(i for i, score in enumerate(scores) if score >= max(scores) - 0.002)
    if scores[best] > max(GOOD_OVERLAP, found):
        raise NerfroError(
            f"{state}; the poses are in another convention: with {_ALTERNATIVES[best][0]} they agree to "
            f"{scores[best]:.0%}; correct transform_matrix, or choose the data= format that fits"
        )
    for allowed in _numbers_of_wrong_masks(len(names), wrong_masks):
        each = coarse_agreement(silhouettes, allowed)
        if np.median(each) >= GOOD_OVERLAP:
            odd = [names[view] for view in np.argsort(each, kind="stable")[:allowed]]
            raise NerfroError(
                f"{state}, but not if {allowed} views may be wrong; look at the masks and poses of "
                f"{', '.join(odd)}, and correct them or set wrong_masks={allowed}"
            )
    raise NerfroError(
        f"{state}, and no usual misreading of the poses explains it; check that masks, images and poses belong "
        "together and that the object did not move between the views"
    )


def better_wrong_masks(silhouettes: Silhouettes, wrong_masks: int) -> int | None:
    """The number of views that may be wrong with which a coarse hull looks most like the masks; None if now it does."""
    tried = [wrong_masks, *_numbers_of_wrong_masks(len(silhouettes), wrong_masks)]
    agreements = [float(coarse_agreement(silhouettes, allowed).mean()) for allowed in tried]
    best = next(i for i, agreement in enumerate(agreements) if agreement >= max(agreements) - _CLEARLY)
    return tried[best] if agreements[best] > agreements[0] + _CLEARLY else None


def _numbers_of_wrong_masks(num_views: int, more_than: int) -> list[int]:
    """1, 2, 4, ... as far as most views can still outvote them."""
    most = max(1, num_views // _VOTES)
    return [number for number in sorted({2**power for power in range(8)} | {most}) if more_than < number <= most]


def _changed(silhouettes: Silhouettes, inverse: bool, turn: _Turn) -> Silhouettes:
    """The same masks with the poses read differently."""
    poses: Tensor = silhouettes.cameras.camera_to_world
    rotation, centre = poses[:, :, :3], poses[:, :, 3:]
    if inverse:
        rotation = rotation.transpose(1, 2)
        centre = -rotation @ centre
    poses = torch.cat([rotation @ torch.tensor(turn, dtype=rotation.dtype), centre], -1)
    return replace(silhouettes, cameras=replace(silhouettes.cameras, camera_to_world=poses))
