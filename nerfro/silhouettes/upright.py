"""Estimation of the up direction from the camera poses and from the axis of the object."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.core.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh

# Cameras are level if their x axes lie close to a plane (first limit) but not close to a line (second limit); both
# are root mean squares of the sines of the angles.
_MAX_TILT, _MIN_SPREAD = 0.15, 0.3
# Largest angle, in degrees, between the object's axis and the up direction of the cameras, and between the estimated up
# direction and a z axis that counts as up.
_MAX_AXIS_ANGLE, _MAX_Z_ANGLE = 12.0, 3.0
_NUM_SLICES, _MIN_SLICES, _ROUNDS = 16, 6, 10
# Fraction of the height at both ends that is left out, because slices oblique to the end faces are cut off there.
_END_MARGIN = 0.1
# Largest root mean square distance of the centres of the slices from the axis, as a fraction of the height.
_MAX_DEVIATION = 0.02


def find_up(cameras: Cameras, mesh: TriangleMesh) -> tuple[Float[np.ndarray, "3"], str] | None:
    """Estimate the up direction.

    Handheld cameras are level to within some degrees, so their x axes lie in a horizontal plane. An object of
    revolution on a table stands upright more accurately, so the axis of the object is preferred if both agree.

    Returns:
        The unit vector and a description of its origin; None if up is the z axis of the world, or cannot be estimated.
    """
    up = camera_up(cameras)
    if up is None:
        return None
    origin = "from the orientation of the cameras"
    axis = body_axis(mesh, up)
    if axis is not None and axis @ up > np.cos(np.radians(_MAX_AXIS_ANGLE)):
        up, origin = axis, "the object's axis"
    return None if up[2] > np.cos(np.radians(_MAX_Z_ANGLE)) else (up, origin)


def camera_up(cameras: Cameras) -> Float[np.ndarray, "3"] | None:
    """Estimate the direction perpendicular to the cameras' x axes, towards their y axes; None if it is ambiguous."""
    right, upwards = (cameras.camera_to_world[:, :, axis].double().numpy() for axis in (0, 1))
    spread, directions = np.linalg.eigh(right.T @ right / len(right))
    up = directions[:, 0]
    if spread[0] > _MAX_TILT**2 or spread[1] < _MIN_SPREAD**2:
        return None
    return up * np.sign(up @ upwards.mean(0))


def body_axis(mesh: TriangleMesh, near: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """Fit a line through the centres of slices of a mesh; None if the centres are not collinear.

    Slicing perpendicular to the axis and fitting the axis alternate, so that slices of a body of revolution become
    circles.

    Args:
        mesh: surface of the body.
        near: initial direction of the axis.
    """
    corners = mesh.triangles
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middles, axis = corners.mean(1), near
    for _ in range(_ROUNDS):
        height = middles @ axis
        low, high = height.min(), height.max()
        place = (height - low) / (high - low)
        inside = (place > _END_MARGIN) & (place < 1 - _END_MARGIN)
        number = ((place - _END_MARGIN) / (1 - 2 * _END_MARGIN) * _NUM_SLICES).clip(0, _NUM_SLICES - 1).astype(np.int64)
        weight = np.bincount(number[inside], area[inside], _NUM_SLICES)
        if np.count_nonzero(weight) < _MIN_SLICES:
            return None
        sums = [np.bincount(number[inside], area[inside] * middles[inside, a], _NUM_SLICES) for a in range(3)]
        centres = (np.stack(sums, -1) / weight[:, None].clip(1e-30))[weight > 0]
        offsets = centres - centres.mean(0)
        line = np.linalg.svd(offsets)[2][0]
        axis = line * np.sign(line @ near)
    away = offsets - (offsets @ axis)[:, None] * axis
    return axis if np.sqrt((away**2).sum(1).mean()) < _MAX_DEVIATION * (high - low) else None
