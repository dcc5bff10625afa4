"""Import of lens and poses from a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfro.capture.calibration import Calibration, Intrinsics, Pose
from nerfro.data.colmap import lens_of
from nerfro.data.colmap_model import read_colmap
from nerfro.data.lenses import Lens, check_lenses
from nerfro.errors import NerfroError


def import_model(folder: Path, images: Sequence[Path], size: tuple[int, int]) -> tuple[Calibration, Any]:
    """Import a COLMAP model in text or binary format.

    Args:
        folder: folder of the model.
        images: the photographs.
        size: width and height of the photographs, in pixels; the lens is scaled to this size.

    Returns:
        Lens and poses, and the 3-D points [P, 3].

    Raises:
        NerfroError: the model contains none of the images, or more than one camera.
    """
    pycolmap = require_pycolmap()
    parsed = read_colmap(folder)  # this reader detects truncated files, pycolmap does not
    names = {image.name for image in images}
    registered = [image for image in parsed.images if image.name in names]
    if not registered:
        raise NerfroError(
            f"{folder} contains none of the images (its first image is {parsed.images[0].name}); set images= to the "
            "folder that the model was made from"
        )
    numbers = {image.camera for image in registered}
    if len(numbers) > 1:
        raise NerfroError(
            f"{folder} has {len(numbers)} cameras, and the data set that calibrate writes holds one; reconstruct with "
            "a single camera, or train on the model itself with data=colmap"
        )
    camera, where = parsed.cameras[numbers.pop()], f"{folder}: the camera"
    lens = lens_of(camera, where).resized((camera.width, camera.height), size, where)
    check_lenses([lens], [where], size)
    errors = _reprojection_errors(pycolmap.Reconstruction(folder), size[0] / camera.width)
    poses = {}
    for image in registered:
        error, num_points = errors[image.name]
        poses[image.name] = Pose(image.camera_to_world, num_points, error)
    skipped = {image.name: "no pose from COLMAP" for image in images if image.name not in poses}
    return Calibration(_intrinsics(lens), poses, skipped, 0), parsed.points


def _reprojection_errors(reconstruction: Any, scale: float) -> dict[str, tuple[float, int]]:
    """Compute the root mean square reprojection error in pixels and the number of points, by image name."""
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
    k1, k2, k3, _, p1, p2, *below = lens.distortion  # COLMAP's camera models have no k4
    return Intrinsics(matrix, (k1, k2, p1, p2, k3, *below) if k3 or any(below) else (k1, k2, p1, p2))


def require_pycolmap() -> Any:
    """Import pycolmap, or raise an error with the command that installs pycolmap."""
    try:
        import pycolmap
    except ImportError as error:
        raise NerfroError(f"target=colmap needs pycolmap ({error}); pip install 'nerfro[capture]'") from error
    return pycolmap
