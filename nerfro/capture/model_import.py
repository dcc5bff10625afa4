"""Lens and poses of a COLMAP model, and how well it hangs together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from nerfro.capture.calibration import Calibration, Intrinsics, Pose
from nerfro.cli import warn
from nerfro.data.colmap import lens_of
from nerfro.data.colmap_model import read_colmap
from nerfro.data.frames import Lens
from nerfro.errors import NerfroError, first_of

# A group of cameras that shares fewer points with all others, or less than this share of what one of them usually sees,
# may lie anywhere.
_FEWEST_SHARED, _LEAST_SHARE = 30, 0.1
# So many of the weakest links are looked at.
_LINKS = 8


def import_model(folder: Path, images: Sequence[Path], size: tuple[int, int]) -> tuple[Calibration, Any]:
    """Lens and poses of a model, text or binary, for images of a size (width, height), and its 3-D points [P, 3]."""
    pycolmap = require_pycolmap()
    parsed = read_colmap(folder)  # first, for pycolmap does not notice a file that is cut off
    names = {image.name for image in images}
    registered = [image for image in parsed.images if image.name in names]
    if not registered:
        raise NerfroError(
            f"{folder} knows none of the images (its first is {parsed.images[0].name}); set images= to its folder"
        )
    numbers = {image.camera for image in registered}
    if len(numbers) > 1:
        raise NerfroError(
            f"{folder} has {len(numbers)} cameras, and this format holds one; reconstruct with one (single camera), "
            "or train on the model itself: data=colmap"
        )
    camera, where = parsed.cameras[numbers.pop()], f"{folder}: the camera"
    lens = lens_of(camera, where).resized((camera.width, camera.height), size, where)
    reconstruction = pycolmap.Reconstruction(folder)
    _warn_of_loose_groups(reconstruction)
    errors = _reprojection_errors(reconstruction, size[0] / camera.width)
    poses = {}
    for image in registered:
        error, num_points = errors[image.name]
        poses[image.name] = Pose(image.camera_to_world, num_points, error)
    skipped = {image.name: "not placed by COLMAP" for image in images if image.name not in poses}
    return Calibration(_intrinsics(lens), poses, skipped, 0), parsed.points


def loosest_group(seen: Bool[np.ndarray, "V P"]) -> tuple[list[int], int]:
    """The smaller group of cameras that shares fewest points with all others, and how many.

    Cameras are cut apart where the tree of their strongest links is weak. `seen` says which camera sees which point.
    """
    shared = seen.astype(np.int32) @ seen.T.astype(np.int32)
    np.fill_diagonal(shared, 0)
    tree = minimum_spanning_tree(1 / np.maximum(shared, 1e-3)).tocoo()
    links = np.argsort(-tree.data)[:_LINKS]
    cuts = []
    for link in links:
        rest = tree.copy()
        rest.data[link] = 0
        rest.eliminate_zeros()
        _, side = connected_components(rest, directed=False)
        group = side == (np.bincount(side).argmin())
        cuts.append((int((seen[group].any(0) & seen[~group].any(0)).sum()), np.flatnonzero(group).tolist()))
    count, chosen = min(cuts)
    return chosen, count


def _warn_of_loose_groups(reconstruction: Any) -> None:
    """Repeating patterns make pairs of images agree that see different things; such groups hang on few points."""
    images = [image for image in reconstruction.images.values() if image.has_pose]
    if len(images) < 2 or not reconstruction.points3D:
        return
    column = {number: place for place, number in enumerate(reconstruction.points3D)}
    seen = np.zeros((len(images), len(column)), bool)
    for row, image in enumerate(images):
        seen[row, [column[f.point3D_id] for f in image.points2D if f.has_point3D()]] = True
    group, shared = loosest_group(seen)
    if shared < max(_FEWEST_SHARED, _LEAST_SHARE * float(np.median(seen[group].sum(1)))):
        names = first_of(sorted(images[place].name for place in group))
        warn(
            f"{names}: placed by {shared} points that they share with the other {len(images) - len(group)} images, so "
            "perhaps in the wrong place (patterns that repeat look alike); look at cameras.png, photograph views "
            "between, or make the model anew with pairs=sequential"
        )


def _reprojection_errors(reconstruction: Any, scale: float) -> dict[str, tuple[float, int]]:
    """Root mean square in pixels and number of points, by image."""
    errors = {}
    for image in reconstruction.images.values():
        residuals = []
        for feature in image.points2D:
            if feature.has_point3D():
                projected = image.project_point(reconstruction.points3D[feature.point3D_id].xyz)
                if projected is not None:
                    residuals.append(np.linalg.norm(projected - feature.xy))
        error = scale * float(np.sqrt(np.mean(np.square(residuals)))) if residuals else float("nan")
        errors[image.name] = error, len(residuals)
    return errors


def _intrinsics(lens: Lens) -> Intrinsics:
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    if lens.distortion is None:
        return Intrinsics(matrix)
    k1, k2, k3, _, p1, p2, *below = lens.distortion  # COLMAP's models have no fourth
    return Intrinsics(matrix, (k1, k2, p1, p2, k3, *below) if k3 or any(below) else (k1, k2, p1, p2))


def require_pycolmap() -> Any:
    """pycolmap, or an error that says how to install it."""
    try:
        import pycolmap
    except ImportError as error:
        raise NerfroError(f"target=colmap needs pycolmap ({error}); pip install 'nerfro[capture]'") from error
    return pycolmap
