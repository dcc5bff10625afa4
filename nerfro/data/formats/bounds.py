"""Near and far bounds of rays, estimated from cameras and sparse points."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.data.lenses import Lens
from nerfro.geometry.lines import nearest_point
from nerfro.registry.allowed import Coordinate

_MAX_COORDINATE = get_args(Coordinate)[2].le  # world units


def find_bounds(
    poses: Float[np.ndarray, "V 3 4"], edges: Float[np.ndarray, "V 2 2"], points: Float[np.ndarray, "points 3"]
) -> tuple[float, float]:
    """Estimate the near and far bounds of all cameras.

    With points, the bounds are 0.9 times the distance of the nearest point in any view and 1.1 times the distance of
    the farthest one. Without points, they follow from the target, the point nearest to all optical axes: near is a
    tenth of the distance of the nearest camera, far is twice the distance of the farthest camera.

    Args:
        poses: camera-to-world matrices with OpenGL axes, world units.
        edges: lower left and upper right corner of each image at unit depth, see `image_edges`.
        points: sparse points in world units; may be empty.

    Returns:
        Near and far, arc lengths in world units.

    Raises:
        NerfroError: no points are in view and the cameras have no common target.
    """
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    distances_in_view = [_distances_in_view(points, *camera) for camera in zip(poses, edges, strict=True)]
    quantiles = [0.001, 1 - 0.001]  # outliers at both ends are left out
    ranges = np.array([np.quantile(distances, quantiles) for distances in distances_in_view if len(distances)])
    if len(ranges):
        return 0.9 * float(ranges[:, 0].min()), 1.1 * float(ranges[:, 1].max())
    to_target = nearest_point(centres, forward) - centres
    distances = np.linalg.norm(to_target, axis=1)
    sees_target = (to_target * forward).sum(1) > 0.87 * distances
    # The cameras share a target if it lies in front of at least 90 % of them, within 30 degrees of the optical axis.
    if sees_target.mean() < 0.9 or not distances.min() > 0:
        raise NerfroError(
            "data.near and data.far cannot be found: the cameras have no common target, and the data set has no sparse "
            "points; set both, in world units"
        )
    return 0.1 * float(distances.min()), 2 * float(distances.max())


def image_edges(lens: Lens, width: int, height: int) -> Float[np.ndarray, "2 2"]:
    """Return the lower left and the upper right corner of an image at unit depth, x right and y up, undistorted."""
    left, right = -lens.cx / lens.fx, (width - lens.cx) / lens.fx
    return np.array([[left, (lens.cy - height) / lens.fy], [right, lens.cy / lens.fy]])


def usable_points(points: Float[np.ndarray, "points 3"], file: Path) -> Float[np.ndarray, "usable 3"]:
    """Return the points of a file within the coordinates that nerfro accepts; outliers may lie beyond these.

    Raises:
        NerfroError: a coordinate is NaN or infinite.
    """
    if not np.isfinite(points).all():
        raise NerfroError(f"{file} holds points that are NaN or infinite; export the reconstruction again")
    return points[(np.abs(points) <= _MAX_COORDINATE).all(1)]


def _distances_in_view(
    points: Float[np.ndarray, "points 3"], pose: Float[np.ndarray, "3 4"], edges: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, " usable"]:
    """Compute the distances of the points inside the view frustum; distortion is neglected."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    low, high = edges[:, None] * -local[:, 2:]
    inside = ((low < local[:, :2]) & (local[:, :2] < high)).all(1)
    return np.linalg.norm(local[inside], axis=1)
