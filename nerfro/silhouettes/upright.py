"""Estimation of the up direction from the camera poses and from the axis of the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerfro.core.cameras import MIN_MEAN_UP, Cameras
from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import area_vectors


@dataclass(frozen=True)
class UprightSettings(AlgorithmSettings):
    """Settings of the estimation of the up direction (`find_up`).

    Attributes:
        max_tilt: largest root mean square of the sines of the angles between the cameras' x axes and a common plane,
            for level cameras.
        min_spread: smallest root mean square of the sines of the angles between the x axes and a common line.
        max_axis_angle: largest angle in degrees between the object's axis and the up direction of the cameras.
        max_z_angle: largest angle in degrees between the estimated up direction and a z axis that counts as up.
        num_slices: number of slices of the object along its axis.
        min_slices: smallest number of slices that meet the surface.
        rounds: number of alternations between slicing and fitting of the axis.
        end_margin: fraction of the height at both ends that is left out, because slices oblique to the end faces are
            cut off there.
        max_deviation: largest root mean square distance of the centres of the slices from the axis, as a fraction of
            the height.
    """

    max_tilt: float = 0.15
    min_spread: float = 0.3
    max_axis_angle: float = 12.0
    max_z_angle: float = 3.0
    num_slices: int = 16
    min_slices: int = 6
    rounds: int = 10
    end_margin: float = 0.1
    max_deviation: float = 0.02


def find_up(
    cameras: Cameras, mesh: TriangleMesh, settings: UprightSettings = UprightSettings()
) -> tuple[Float[np.ndarray, "3"], str] | None:
    """Estimate the up direction.

    Handheld cameras are level to within some degrees, so their x axes lie in a horizontal plane. An object of
    revolution on a table stands upright more accurately, so the axis of the object is preferred if both agree.

    Returns:
        The unit vector and a description of its origin; None if up is the z axis of the world, or cannot be estimated.
    """
    settings.use()
    up = camera_up(cameras, settings)
    if up is None:
        return None
    origin = "from the orientation of the cameras"
    axis = body_axis(mesh, up, settings)
    if axis is not None and axis @ up > np.cos(np.radians(settings.max_axis_angle)):
        up, origin = axis, "the object's axis"
    return None if up[2] > np.cos(np.radians(settings.max_z_angle)) else (up, origin)


def camera_up(cameras: Cameras, settings: UprightSettings = UprightSettings()) -> Float[np.ndarray, "3"] | None:
    """Estimate the direction perpendicular to the cameras' x axes, towards their y axes.

    Returns:
        The unit vector; None if it is ambiguous, or the cameras look along it, so that noise decides its sign.
    """
    right, upwards = (cameras.camera_to_world[:, :, axis].double().numpy() for axis in (0, 1))
    spread, directions = np.linalg.eigh(right.T @ right / len(right))
    up = directions[:, 0]
    upward = up @ upwards.mean(0)
    if spread[0] > settings.max_tilt**2 or spread[1] < settings.min_spread**2 or abs(upward) < MIN_MEAN_UP:
        return None
    return up * np.sign(upward)


def body_axis(
    mesh: TriangleMesh, near: Float[np.ndarray, "3"], settings: UprightSettings = UprightSettings()
) -> Float[np.ndarray, "3"] | None:
    """Fit a line through the centres of slices of a mesh; None if the centres are not collinear.

    Slicing perpendicular to the axis and fitting the axis alternate, so that slices of a body of revolution become
    circles.

    Args:
        mesh: surface of the body.
        near: initial direction of the axis.
        settings: settings of the slices.
    """
    area, middles, axis = 0.5 * np.linalg.norm(area_vectors(mesh.triangles), axis=1), mesh.triangles.mean(1), near
    margin, num_slices = settings.end_margin, settings.num_slices
    for _ in range(settings.rounds):
        height = middles @ axis
        low, high = height.min(), height.max()
        fraction = (height - low) / (high - low)
        inside = (fraction > margin) & (fraction < 1 - margin)
        number = ((fraction - margin) / (1 - 2 * margin) * num_slices).clip(0, num_slices - 1).astype(np.int64)
        weight = np.bincount(number[inside], area[inside], num_slices)
        if np.count_nonzero(weight) < settings.min_slices:
            return None
        sums = [np.bincount(number[inside], area[inside] * middles[inside, a], num_slices) for a in range(3)]
        centres = (np.stack(sums, -1) / weight[:, None].clip(1e-30))[weight > 0]
        offsets = centres - centres.mean(0)
        line = np.linalg.svd(offsets)[2][0]
        axis = line * np.sign(line @ near)
    away = offsets - (offsets @ axis)[:, None] * axis
    return axis if np.sqrt((away**2).sum(1).mean()) < settings.max_deviation * (high - low) else None
