"""Camera paths around an object, and files of cameras.

The readers take nerfstudio's camera paths and transforms.json; the writer saves refined cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.camera.base import CameraModel
from nerfro.camera.refined.refined import motion_between
from nerfro.core.cameras import Cameras, up_direction
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import relative_path
from nerfro.core.types import WORLD_ORIGIN
from nerfro.data.base import DataSource, Views
from nerfro.data.frames import check_pose
from nerfro.data.image_files import read_size
from nerfro.data.lenses import Lens, check_lenses, lens_tensors, read_lens
from nerfro.data.transforms import existing_image
from nerfro.files.atomic import write_json
from nerfro.files.reading import is_number, parse_matrix, read_json


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


# Names of the nine coefficients (`nerfro.core.lens`) without and with a denominator. OpenCV's rational model has no
# r^8.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_RATIONAL = ("k1", "k2", "k3", "", "p1", "p2", "k4", "k5", "k6")
# Keys of a lens in pixels, which need the size of the images.
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy", "cam_mat")


def cameras_of_file(file: Path, geometry: CaptureGeometry, source: DataSource) -> Cameras:
    """Read the cameras of a file, and print their size and the convention of their poses.

    A file of the data set, or a copy of it, has the cameras that training uses, with the camera axes of the data format
    and in the resolution of the photographs. See `read_cameras` for other files.
    """
    own = source.cameras_of(file)
    cameras = read_cameras(file, geometry, source.origin) if own is None else own
    poses = "of the data set" if own is not None else "with OpenGL axes (x right, y up, view along -z), in world units"
    print(f"{file}: {len(cameras)} cameras of {cameras.width}x{cameras.height} pixels, {poses}")
    offset = geometry.centre - cameras.camera_to_world[:, :, 3].cpu()
    if own is None and bool(((offset * -cameras.camera_to_world[:, :, 2].cpu()).sum(-1) < 0).all()):
        warn(f"all cameras of {file} look away from the object; give poses with OpenGL axes: view along -z, y up")
    return cameras


def read_cameras(file: Path, geometry: CaptureGeometry, origin: Float[np.ndarray, "3"] = WORLD_ORIGIN) -> Cameras:
    """Read the cameras of a file, with poses in the world of the training data.

    The file is a camera path of nerfstudio (`camera_path`: poses and vertical fields of view) or a `transforms.json`
    (`frames`: poses and intrinsics). Poses are camera-to-world matrices with OpenGL axes, in world units.

    The size in pixels is stated by `render_width` and `render_height`, or by `w` and `h`. Without `w` and `h`, it is
    the size of the image of the first frame. Without an image, it is the size of the photographs, and lengths in pixels
    (`fl_x`, `cx`) are refused.

    Args:
        file: JSON file.
        geometry: geometry of the training data.
        origin: world coordinates of the origin of the result.

    Raises:
        NerfroError: the file has another format, or a value is missing or invalid.
    """
    document = read_json(file, "check the path")
    lens_of: Callable[[Mapping[str, Any], Mapping[str, Any], tuple[int, int], str], Lens] = read_lens
    if isinstance(document, dict) and isinstance(document.get("camera_path"), list):
        size = ("render_width", "render_height")
        entries, pose_key, lens_of = document["camera_path"], "camera_to_world", _lens_of_path
    elif isinstance(document, dict) and isinstance(document.get("frames"), list):
        size, entries, pose_key = ("w", "h"), document["frames"], "transform_matrix"
    else:
        raise NerfroError(
            f"{file} has neither 'camera_path' nor 'frames'; give nerfstudio's camera path, or transforms"
        )
    if not entries:
        raise NerfroError(f"{file} has no cameras; give one or more")
    sizes = {**entries[0], **document} if isinstance(entries[0], dict) else document
    defaults = geometry.camera.width, geometry.camera.height
    if size == ("w", "h") and any(sizes.get(key) is None for key in size):
        defaults = _size_of_image(file, document, defaults)
    width, height = (_pixels(sizes, key, default, file) for key, default in zip(size, defaults, strict=True))
    poses, lenses = [], []
    for number, entry in enumerate(entries):
        where = f"{file}: camera {number}"
        if not isinstance(entry, dict) or pose_key not in entry:
            raise NerfroError(f"{where} has no '{pose_key}'; add it")
        flat = np.asarray(entry[pose_key], dtype=object)
        matrix = flat.reshape(-1, 4).tolist() if flat.size in (12, 16) else entry[pose_key]
        poses.append(check_pose(parse_matrix(matrix, ((3, 4), (4, 4)), where), where, pose_key))
        lenses.append(lens_of(document, entry, (width, height), where))
    check_lenses(lenses, [f"{file}: camera {number}" for number in range(len(lenses))], (width, height))
    intrinsics, distortion = lens_tensors(lenses)
    fx, fy, cx, cy = intrinsics.float().unbind(-1)
    pose = np.stack(poses)
    pose[:, :, 3] -= origin
    return geometry.with_ray_bounds(
        replace(
            geometry.camera, camera_to_world=torch.from_numpy(pose).float(), fx=fx, fy=fy, cx=cx, cy=cy,
            width=width, height=height, distortion=distortion,
        )
    )  # fmt: skip


def stated_seconds(file: Path) -> float | None:
    """Return the duration of a film, as the camera paths of nerfstudio and of the page state it; None without one."""
    document = read_json(file, "check the path")
    seconds = document.get("seconds") if isinstance(document, dict) else None
    return float(seconds) if is_number(seconds) and seconds > 0 else None


def write_cameras(file: Path, camera: CameraModel, views: Views, origin: Float[np.ndarray, "3"] = WORLD_ORIGIN) -> None:
    """Write the estimated training cameras as a `transforms.json` for `data=nerfstudio`, if cameras are optimized.

    Positions of `views` are relative to `origin`. Each frame also has the motion of its camera (`turned_degrees`, and
    `shifted` in world units) and its `gain`.
    """
    if not camera.moves and camera.exposure is None:
        return
    initial, estimated = views.cameras, camera.estimated(views.cameras).to("cpu")
    turned, shifted = (values.tolist() for values in motion_between(initial.camera_to_world, estimated.camera_to_world))
    gains = None if camera.exposure is None else camera.exposure.gains().tolist()
    images = [relative_path(frame.image, file.parent) for frame in views.frames]
    document = transforms_document(estimated, images, origin)
    for view, entry in enumerate(document["frames"]):
        entry |= {"turned_degrees": turned[view], "shifted": shifted[view]}
        if gains is not None:
            entry["gain"] = gains[view]
    write_json(file, document)


def transforms_document(
    cameras: Cameras, images: Sequence[str], origin: Float[np.ndarray, "3"] = WORLD_ORIGIN
) -> dict[str, Any]:
    """Return the content of a `transforms.json` with the paths of the images of cameras relative to `origin`."""
    rational = cameras.distortion is not None and bool(cameras.distortion[:, 6:].any())
    names = _RATIONAL if rational else _DISTORTION
    lens = {"fl_x": cameras.fx, "fl_y": cameras.fy, "cx": cameras.cx, "cy": cameras.cy}
    frames = []
    for view, image in enumerate(images):
        entry: dict[str, Any] = {"file_path": image}
        entry |= {name: float(values[view]) for name, values in lens.items()}
        if cameras.distortion is not None:
            entry |= {name: k for name, k in zip(names, cameras.distortion[view].tolist(), strict=False) if name}
        pose = cameras.camera_to_world[view].double().numpy()
        pose[:, 3] += origin
        frames.append({**entry, "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]})
    model = "FULL_OPENCV" if rational else "OPENCV"
    axis = cameras.turntable
    turntable = {} if axis is False else {"turntable": True} if axis is True else {"turntable_axis": axis}
    return {"camera_model": model, "w": cameras.width, "h": cameras.height, **turntable, "frames": frames}


def _lens_of_path(document: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Lens:
    entry = {**document, **entry}
    angle = entry.get("fov")
    if entry.get("camera_type", "perspective") != "perspective":
        raise NerfroError(f"{where}: camera_type={entry['camera_type']!r} is not supported; take perspective")
    if not is_number(angle) or not 0 < angle < 180:
        raise NerfroError(f"{where}: fov={angle!r} must be the vertical field of view, between 0 and 180 degrees")
    return replace(Lens.of_angle(math.radians(angle), size[1], size[1]), cx=0.5 * size[0])


def _size_of_image(file: Path, document: Mapping[str, Any], default: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of the image of the first frame, or the default for lenses without lengths in pixels."""
    levels = [document, *(entry for entry in document["frames"] if isinstance(entry, dict))]
    name = levels[1].get("file_path") if len(levels) > 1 else None
    image = existing_image(file.parent, name.replace("\\", "/")) if isinstance(name, str) else None
    if image is not None:
        return read_size(image)[:2]
    key = next((key for key in _IN_PIXELS if any(level.get(key) is not None for level in levels)), None)
    if key is not None:
        raise NerfroError(
            f"{file} has {key} in pixels, but neither w and h nor the image of its first frame; add w and h, the size "
            "of the images that the lens was calibrated for"
        )
    return default


def _pixels(document: Mapping[str, Any], key: str, default: int, file: Path) -> int:
    value = default if document.get(key) is None else document[key]
    if not is_number(value) or value < 1:
        raise NerfroError(f"{file}: {key}={value!r} is not a number of pixels; give 1 or more")
    return int(value)
