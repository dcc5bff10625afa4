"""Which way is up where nobody has said it: from how cameras were held, and from the axis of what stands upright."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.cameras import Cameras
from nerfro.geometry.mesh import TriangleMesh

# Cameras are held level if their right-hand axes are so nearly in a plane, and no line: root of the mean square of the
# sines of the angles to it.
_LEVEL, _AROUND = 0.15, 0.3
# What stands upright has its axis within this of what cameras say, degrees; a world's z so near to it is up.
_UPRIGHT, _SAME = 12.0, 3.0
_SLICES, _FEWEST, _ROUNDS = 16, 6, 10
# The lowest and the highest part of a body are left out: slices that are not parallel to its ends cut them.
_MIDDLE = 0.1
# A body has an axis if its slices' middles lie so near to it, share of the height.
_STRAIGHT = 0.02


def find_up(cameras: Cameras, mesh: TriangleMesh) -> tuple[Float[np.ndarray, "3"], str] | None:
    """The unit vector that points up, and what told it; None where that is the world's z, or nothing tells it.

    People hold cameras level, so their right-hand axes lie in a plane: to some degrees. A glass on a table stands
    truer than that, so its axis is taken where it is near.
    """
    up = camera_up(cameras)
    if up is None:
        return None
    told = "from the way in which the cameras were held"
    axis = body_axis(mesh, up)
    if axis is not None and axis @ up > np.cos(np.radians(_UPRIGHT)):
        up, told = axis, "the object's axis"
    return None if up[2] > np.cos(np.radians(_SAME)) else (up, told)


def camera_up(cameras: Cameras) -> Float[np.ndarray, "3"] | None:
    """The direction that most cameras' right-hand axes are perpendicular to, on the side of their upper edges."""
    right, upwards = (cameras.camera_to_world[:, :, axis].double().numpy() for axis in (0, 1))
    spread, directions = np.linalg.eigh(right.T @ right / len(right))
    up = directions[:, 0]
    if spread[0] > _LEVEL**2 or spread[1] < _AROUND**2:
        return None
    return up * np.sign(up @ upwards.mean(0))


def body_axis(mesh: TriangleMesh, near: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """The line through the middles of a body's slices across a direction; None where they are on no line.

    Slices are taken across the line that was found, and so on, so that those of a body of revolution are circles.
    """
    corners = mesh.triangles
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middles, axis = corners.mean(1), near
    for _ in range(_ROUNDS):
        height = middles @ axis
        low, high = height.min(), height.max()
        place = (height - low) / (high - low)
        inside = (place > _MIDDLE) & (place < 1 - _MIDDLE)
        number = ((place - _MIDDLE) / (1 - 2 * _MIDDLE) * _SLICES).clip(0, _SLICES - 1).astype(np.int64)
        weight = np.bincount(number[inside], area[inside], _SLICES)
        if np.count_nonzero(weight) < _FEWEST:
            return None
        sums = [np.bincount(number[inside], area[inside] * middles[inside, a], _SLICES) for a in range(3)]
        centres = (np.stack(sums, -1) / weight[:, None].clip(1e-30))[weight > 0]
        offsets = centres - centres.mean(0)
        line = np.linalg.svd(offsets)[2][0]
        axis = line * np.sign(line @ near)
    away = offsets - (offsets @ axis)[:, None] * axis
    return axis if np.sqrt((away**2).sum(1).mean()) < _STRAIGHT * (high - low) else None
