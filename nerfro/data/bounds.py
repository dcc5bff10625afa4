"""Where rays begin and end, found from cameras and sparse points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.errors import NerfroError
from nerfro.geometry.lines import nearest_point

# Cameras look at one place where it lies within 30 degrees of nearly all optical axes, and in front.
_TOWARDS, _NEARLY_ALL = 0.87, 0.9
# Rays begin at this share of the nearest camera's distance from there: before anything that is photographed.
_NEAR_SHARE = 0.1
# Points farther than this from a camera's axis (cosine) are hardly in its view; a thousandth at each end are strays.
_IN_VIEW, _STRAYS = 0.7, 0.001


def find_bounds(poses: Float[np.ndarray, "V 3 4"], points: Float[np.ndarray, "P 3"]) -> tuple[float, float]:
    """Near and far of cameras (OpenGL axes), world units.

    With points, 0.9 and 1.1 of the distances of the nearest and the farthest one in any view. Without, from the place
    where the optical axes meet: near is a tenth of the least distance from it, far the greatest distance twice, which
    reaches the other side of the cameras.

    Raises:
        NerfroError: there are no points in view, and the cameras look at no common place.
    """
    centres, forward = poses[:, :, 3], -poses[:, :, 2]
    seen = [_distances_in_view(points, *camera) for camera in zip(centres, forward, strict=True)]
    ends = np.array([np.quantile(each, [_STRAYS, 1 - _STRAYS]) for each in seen if len(each)])
    if len(ends):
        return 0.9 * float(ends[:, 0].min()), 1.1 * float(ends[:, 1].max())
    towards = nearest_point(centres, forward) - centres
    distances = np.linalg.norm(towards, axis=1)
    looks = (towards * forward).sum(1) > _TOWARDS * distances
    if looks.mean() < _NEARLY_ALL or not distances.min() > 0:
        raise NerfroError(
            "data.near and data.far cannot be found: the cameras look at no common place, and there are no sparse "
            "points; give both, in units of the poses"
        )
    return _NEAR_SHARE * float(distances.min()), 2 * float(distances.max())


def _distances_in_view(
    points: Float[np.ndarray, "P 3"], centre: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "Q"]:
    offsets = points - centre
    distances = np.linalg.norm(offsets, axis=1)
    return distances[offsets @ forward > _IN_VIEW * distances]
