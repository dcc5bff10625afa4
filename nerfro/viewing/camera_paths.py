"""Camera paths around an object."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.core.cameras import Cameras, up_direction
from nerfro.core.errors import NerfroError


@dataclass(frozen=True)
class OrbitPosition:
    """Position of a camera around the object: angles in degrees, distance in world units."""

    azimuth: float
    elevation: float
    distance: float


@dataclass(frozen=True)
class CaptureGeometry:
    """Position of an object relative to the cameras of its photographs.

    Attributes:
        centre: centre of the object, world units.
        up: unit up direction, see `up_direction`.
        distance: median distance of the cameras from the centre, world units.
        camera: one of the cameras, without distortion and with a centred principal point; its lens and resolution are
            the defaults of new cameras.
    """

    centre: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    distance: float
    camera: Cameras

    @classmethod
    def of(cls, cameras: Cameras, bounds: Float[Tensor, "2 3"]) -> CaptureGeometry:
        """Measure the geometry of photographs of an object in the given bounds."""
        cameras, centre = cameras.to("cpu"), bounds.mean(0)
        distance = torch.linalg.vector_norm(cameras.camera_to_world[:, :, 3] - centre, dim=-1).median()
        first = cameras.select([0])
        cx, cy = (torch.full_like(first.cx, 0.5 * side) for side in (first.width, first.height))
        camera = replace(first, cx=cx, cy=cy, distortion=None)
        return cls(centre, up_direction(cameras.camera_to_world[:, :, 1]), float(distance), camera)

    def pose_at(self, position: OrbitPosition) -> Float[Tensor, "3 4"]:
        """Return the pose of an upright camera that looks at the centre, also from above and below.

        Azimuth 0 is along the x axis of the world, or y if x is up.
        """
        x = torch.eye(3)[int(self.up[0].abs() > 0.9)]
        x = functional.normalize(x - (x @ self.up) * self.up, dim=0)
        y = torch.linalg.cross(self.up, x)
        azimuth, elevation = math.radians(position.azimuth), math.radians(position.elevation)
        right = math.cos(azimuth) * y - math.sin(azimuth) * x
        back = math.cos(elevation) * torch.linalg.cross(right, self.up) + math.sin(elevation) * self.up
        eye = self.centre + position.distance * back
        return torch.stack([right, torch.linalg.cross(back, right), back, eye], -1)

    def look_at(self, positions: Float[Tensor, "V 3"], target: Float[Tensor, "3"]) -> Cameras:
        """Make upright cameras at positions that look at a target, with the lens of the photographs.

        Raises:
            NerfroError: a position is the target, or is not finite.
        """
        distance = torch.linalg.vector_norm(positions - target, dim=-1)
        if not ((distance > 0) & torch.isfinite(distance)).all():
            raise NerfroError("a camera lies at its target, or infinitely far away; give another position or target")
        back = functional.normalize(positions - target, dim=-1)
        right = torch.linalg.cross(self.up.expand_as(back), back)
        # A camera directly above has no upright orientation; any horizontal axis is as good as another.
        horizontal = torch.linalg.cross(self.up, torch.eye(3)[self.up.abs().argmin()])
        above = torch.linalg.vector_norm(right, dim=-1, keepdim=True) < 1e-4
        right = functional.normalize(torch.where(above, horizontal, right), dim=-1)
        return self.cameras_at(torch.stack([right, torch.linalg.cross(back, right), back, positions], -1))

    def cameras_at(self, poses: Float[Tensor, "V 3 4"]) -> Cameras:
        """Make cameras with given poses and the lens of the photographs."""
        return self.with_ray_bounds(replace(self.camera.select([0] * len(poses)), camera_to_world=poses))

    def with_ray_bounds(self, cameras: Cameras) -> Cameras:
        """Set near and far so that rays enclose the object by the same margins as the rays of the photographs."""
        offset = torch.linalg.vector_norm(cameras.camera_to_world[:, :, 3] - self.centre, dim=-1) - self.distance
        near, far = self.camera.near + float(offset.min()), self.camera.far + float(offset.max())
        return replace(cameras, near=max(near, 0.0), far=max(far, self.camera.far))


def orbit(start: OrbitPosition, fraction: float) -> OrbitPosition:
    """Circle the object once at constant elevation."""
    return replace(start, azimuth=start.azimuth + 360 * fraction)


def spiral(start: OrbitPosition, fraction: float) -> OrbitPosition:
    """Circle the object twice, rising from the negative of the elevation to the elevation."""
    return replace(start, azimuth=start.azimuth + 720 * fraction, elevation=start.elevation * (2 * fraction - 1))


def arc(start: OrbitPosition, fraction: float) -> OrbitPosition:
    """Swing to and fro over 60 degrees, without a stop at the turning points."""
    return replace(start, azimuth=start.azimuth + 30 * math.sin(2 * math.pi * fraction))


def dolly(start: OrbitPosition, fraction: float) -> OrbitPosition:
    """Approach the object from one and a half times the distance to three quarters of the distance."""
    return replace(start, distance=start.distance * 1.5 * 0.5**fraction)


# Function of each path, and whether the path is closed: a closed path does not repeat its first position at the end.
PATHS: dict[str, tuple[Callable[[OrbitPosition, float], OrbitPosition], bool]] = {
    "orbit": (orbit, True),
    "spiral": (spiral, False),
    "arc": (arc, True),
    "dolly": (dolly, False),
}


def path_cameras(geometry: CaptureGeometry, name: str, start: OrbitPosition, num_frames: int) -> Cameras:
    """Make the cameras of a path in `PATHS`, which look at the centre of the object."""
    path, closed = PATHS[name]
    last = num_frames if closed else max(num_frames - 1, 1)
    poses = [geometry.pose_at(path(start, frame / last)) for frame in range(num_frames)]
    return geometry.cameras_at(torch.stack(poses))


def between_keys(keys: Cameras, num_frames: int) -> Cameras:
    """Interpolate cameras as key frames at equal intervals of time, from the first to the last one.

    Positions follow a cubic spline, and rotations a spline of continuous angular acceleration (SciPy); lenses change
    linearly.

    Raises:
        NerfroError: there are less than two cameras.
    """
    if len(keys) < 2:
        raise NerfroError(f"frames={num_frames} needs two or more cameras in the file of the path; leave frames out")
    keys = keys.to("cpu")
    times, at = np.arange(len(keys)), np.linspace(0, len(keys) - 1, num_frames)
    poses = keys.camera_to_world.double().numpy()
    turns = scipy.spatial.transform.Rotation.from_matrix(poses[:, :, :3])
    rotations = scipy.spatial.transform.RotationSpline(times, turns)(at).as_matrix()
    positions = scipy.interpolate.CubicSpline(times, poses[:, :, 3])(at)
    of_lens = {name: getattr(keys, name) for name in ("fx", "fy", "cx", "cy", "distortion")}
    lens: dict[str, Any] = {
        name: torch.from_numpy(scipy.interpolate.make_interp_spline(times, values.double().numpy(), k=1)(at)).to(values)
        for name, values in of_lens.items()
        if values is not None
    }
    pose = torch.from_numpy(np.concatenate([rotations, positions[..., None]], -1)).to(keys.camera_to_world)
    return replace(keys, camera_to_world=pose, **lens)
