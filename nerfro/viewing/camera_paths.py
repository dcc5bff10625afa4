"""Camera paths around an object."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.cameras import Cameras

# The world's own axis is up where the photographs' mean is nearer to it than this.
_NEARLY = math.cos(math.radians(15))


@dataclass(frozen=True)
class Surroundings:
    """How an object was photographed: what a path around it goes by.

    Attributes:
        centre: of the object, world units.
        up: unit direction that is up in the photographs.
        distance: median of the cameras' from the centre, world units.
        camera: one of the cameras, for its lens and resolution.
    """

    centre: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    distance: float
    camera: Cameras

    @classmethod
    def of(cls, cameras: Cameras, bounds: Float[Tensor, "2 3"]) -> Surroundings:
        """Those of photographs of an object within bounds."""
        cameras = cameras.to("cpu")
        centre = bounds.mean(0)
        mean = functional.normalize(cameras.camera_to_world[:, :, 1].mean(0), dim=0)
        axis = torch.zeros(3)
        axis[mean.abs().argmax()] = mean[mean.abs().argmax()].sign()
        distance = torch.linalg.vector_norm(cameras.camera_to_world[:, :, 3] - centre, dim=-1).median()
        up = axis if float(mean @ axis) > _NEARLY else mean
        return cls(centre, up, float(distance), replace(cameras.select([0]), distortion=None))

    def place(self, azimuth: float, elevation: float, distance: float) -> Float[Tensor, "3"]:
        """The point at angles in degrees around the centre; azimuth 0 is on the side of the world's x axis, or y's."""
        x = torch.eye(3)[int(self.up[0].abs() > 0.9)]
        x = functional.normalize(x - (x @ self.up) * self.up, dim=0)
        y = torch.linalg.cross(self.up, x)
        around, above = math.radians(azimuth), math.radians(elevation)
        level = math.cos(around) * x + math.sin(around) * y
        return self.centre + distance * (math.cos(above) * level + math.sin(above) * self.up)

    def looking(self, positions: Float[Tensor, "V 3"], target: Float[Tensor, "3"]) -> Cameras:
        """Cameras at positions that look at a target, with the photographs' lens, upright.

        Bounds of their rays move with the camera, so that these enclose the object as those of the photographs do.
        """
        back = functional.normalize(positions - target, dim=-1)
        # Straight from above there is no upright: any axis across will do.
        up = torch.where((back @ self.up).abs()[:, None] > 0.9999, self.up.roll(1), self.up)
        right = functional.normalize(torch.linalg.cross(up, back), dim=-1)
        pose = torch.stack([right, torch.linalg.cross(back, right), back, positions], -1)
        return self.bounded(replace(self.camera.select([0] * len(positions)), camera_to_world=pose))

    def bounded(self, cameras: Cameras) -> Cameras:
        """Cameras whose rays begin and end as far before and behind the object as those of the photographs do."""
        away = torch.linalg.vector_norm(cameras.camera_to_world[:, :, 3] - self.centre, dim=-1) - self.distance
        near, far = self.camera.near + float(away.min()), self.camera.far + float(away.max())
        return replace(cameras, near=max(near, 0.0), far=max(far, self.camera.far))


@dataclass(frozen=True)
class Flight:
    """Where a path goes, in numbers: angles in degrees, the distance in world units."""

    azimuth: float
    elevation: float
    distance: float


def orbit(start: Flight, share: float) -> Flight:
    """Once around at one height."""
    return replace(start, azimuth=start.azimuth + 360 * share)


def spiral(start: Flight, share: float) -> Flight:
    """Twice around, rising from as far below the object as it ends above."""
    return replace(start, azimuth=start.azimuth + 720 * share, elevation=start.elevation * (2 * share - 1))


def arc(start: Flight, share: float) -> Flight:
    """To and fro over 60 degrees, without a stop where it turns."""
    return replace(start, azimuth=start.azimuth + 30 * math.sin(2 * math.pi * share))


def dolly(start: Flight, share: float) -> Flight:
    """Towards the object: from one and a half times the distance to three quarters of it."""
    return replace(start, distance=start.distance * 1.5 * 0.5**share)


# Paths that end where they began leave their last place to the first frame of the next round.
PATHS: dict[str, tuple[Callable[[Flight, float], Flight], bool]] = {
    "orbit": (orbit, True),
    "spiral": (spiral, False),
    "arc": (arc, True),
    "dolly": (dolly, False),
}


def fly(around: Surroundings, name: str, start: Flight, num_frames: int) -> Cameras:
    """The cameras of a path by its name in `PATHS`, all of which look at the object's centre."""
    path, closed = PATHS[name]
    flights: Sequence[Flight] = [path(start, share) for share in shares(num_frames, closed)]
    positions = [around.place(flight.azimuth, flight.elevation, flight.distance) for flight in flights]
    return around.looking(torch.stack(positions), around.centre)


def shares(num_frames: int, closed: bool) -> list[float]:
    """Where frames lie on a path, from 0 to 1, which a closed path does not repeat."""
    last = num_frames if closed else max(num_frames - 1, 1)
    return [frame / last for frame in range(num_frames)]
