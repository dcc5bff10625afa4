"""Options of `python -m nerfro.render`, and the cameras and scenes that they select."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Float
from omegaconf import MISSING
from torch import Tensor

from nerfro.cli.calls import changed_settings
from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.lens import distort, fold_radius
from nerfro.core.paths import user_path
from nerfro.core.variants import variant
from nerfro.data.lenses import Lens, check_lenses
from nerfro.registry.allowed import Count, Positive, refuse_unused
from nerfro.samplers.subdivision import SubdivisionChanges
from nerfro.viewing.camera_paths import (
    PATHS,
    CaptureGeometry,
    OrbitPosition,
    between_keys,
    cameras_of_file,
    path_cameras,
    stated_seconds,
)
from nerfro.viewing.trained_scene import TrainedScene

Angle = Annotated[float, Gt(0), Lt(180)]
_OF_PATHS = ("azimuth", "elevation", "distance")  # options of paths around the object
FilmFormat = Literal["mp4", "gif"]


@dataclass
class RenderConfig:
    """Options of `python -m nerfro.render`; `path`, `views` or `position` selects the cameras.

    Attributes:
        checkpoint: run folder or a checkpoint in it.
        path: path around the object: orbit, spiral, arc or dolly; or FILE.json of cameras.
        frames: number of frames of the film, by default 120, or as many as a file has cameras; with another number, the
            cameras of the file are key frames, which splines connect.
        seconds: duration of the film; by default that of the file of cameras (`seconds`), or 5.
        azimuth: start of the path, degrees around the object.
        elevation: start of the path, degrees above the object.
        distance: distance from the centre of the object at the start, world units; by default that of the
            photographs.
        views: cameras of a split of the data, such as `test`, or one of them, such as `test:3`.
        position: position of the camera of a still image, world units.
        target: point in the centre of the still image, world units; by default the centre of the object.
        fov: horizontal field of view, degrees; by default that of the photographs.
        resolution: width in pixels, or [width, height]; by default that of the photographs.
        what: rgb, depth, normals (of the glass), content_normals, opacity, exits, glass (nothing inside), inside (no
            glass), or sky (neither).
        sky: lat-long image that replaces the sky (.hdr, .exr, .png, .jpg).
        subdivision: pixels with several rays (see docs/concepts/background.md); by default as in the evaluation
            of the run.
        chunk_size: rays rendered at once, which limits the memory; by default as in training.
        out: folder of frames and films; an interrupted rendering resumes there.
        format: format of the frames; exr stores values in their units: linear radiance, world units, unit
            vectors.
        film: mp4, gif, both or none.
        root: folder of the data, if it has moved since training.
        device: `cpu` or `cuda`; `auto` means the CPU.
        overwrite: whether other frames in `out` may be replaced.
    """

    checkpoint: str = MISSING
    path: str | None = None
    frames: Count | None = None
    seconds: Positive | None = None
    azimuth: float = 0.0
    elevation: Annotated[float, Ge(-90), Le(90)] = 10.0
    distance: Positive | None = None
    views: str | None = None
    position: list[float] | None = None
    target: list[float] | None = None
    fov: Angle | None = None
    resolution: Any = None
    what: Literal["rgb", "depth", "normals", "content_normals", "opacity", "exits", "glass", "inside", "sky"] = "rgb"
    sky: str | None = None
    subdivision: SubdivisionChanges = dataclasses.field(default_factory=SubdivisionChanges)
    chunk_size: Count | None = None
    out: str = MISSING
    format: Literal["png", "exr"] = "png"
    film: list[FilmFormat] = dataclasses.field(default_factory=lambda: ["mp4"])
    root: str | None = None
    device: str = "auto"
    overwrite: bool = False


@dataclass(frozen=True)
class Shots:
    """Cameras in the order of the frames.

    Attributes:
        cameras: camera of each frame.
        names: file name of each frame, without suffix.
        film: whether the frames form a sequence in time.
        seconds: duration of the film.
    """

    cameras: Cameras
    names: list[str]
    film: bool
    seconds: float = 5.0


def check_request(options: RenderConfig) -> None:
    """Check that the options are consistent, before anything is loaded."""
    selectors = [name for name in ("path", "views", "position") if getattr(options, name) is not None]
    if len(selectors) != 1:
        raise NerfroError(
            f"{len(selectors)} options select the cameras ({', '.join(selectors)}); give exactly one of path=orbit, "
            "path=FILE.json, views=test, and position=[X,Y,Z]"
        )
    for name in ("position", "target"):
        if getattr(options, name) is not None and len(getattr(options, name)) != 3:
            raise NerfroError(f"{name}={list(getattr(options, name))} is no point; give three numbers")
    if options.target is not None and options.position is None:
        raise NerfroError(f"target={list(options.target)} needs position=[X,Y,Z]; add the position, or remove target")
    if options.path is not None and options.path not in PATHS and not options.path.endswith(".json"):
        raise NerfroError(f"path={options.path} is not known; give {', '.join(PATHS)}, or a FILE.json of cameras")
    _size(options, 1, 1)
    if options.path not in PATHS:
        refuse_unused(options, _OF_PATHS, f"without path={' or '.join(PATHS)}")
    if options.path is None:
        refuse_unused(options, ("frames", "seconds", "film"), "on still images")
    elif options.format == "exr":
        refuse_unused(options, ("seconds", "film"), "with format=exr, of which no film is made")


def prepared(options: RenderConfig, scene: TrainedScene) -> TrainedScene:
    """Apply the options for rays per pixel, chunk size and sky to a loaded scene."""
    subdivision = replace(scene.subdivision, **changed_settings(options.subdivision))
    renderer = variant(scene.renderer, chunk_size=options.chunk_size or scene.renderer.chunk_size)
    scene = replace(scene, renderer=renderer, subdivision=subdivision)
    return scene if options.sky is None else scene.with_(sky=options.sky)


def find_shots(options: RenderConfig, scene: TrainedScene) -> Shots:
    """Return the selected cameras with their resolution and field of view."""
    shots = _views(options.views, scene) if options.views is not None else _free_cameras(options, scene)
    cameras = shots.cameras
    if cameras.turntable:
        print("turntable: the object turns before the camera; the room behind it stands still")
    if options.fov is not None:
        cameras = _with_field_of_view(cameras, options.fov)
    cameras = _resized(cameras, *_size(options, cameras.width, cameras.height))
    if options.fov is not None or options.resolution is not None:
        _require_invertible(cameras, shots.names)
    return replace(shots, cameras=cameras)


def _free_cameras(options: RenderConfig, scene: TrainedScene) -> Shots:
    """Make the camera of a still image, of a path around the object, or of a file."""
    geometry, seconds = CaptureGeometry.of(scene.cameras("train"), scene.bounds), None
    if options.position is not None:
        target = geometry.centre if options.target is None else _local(options.target, scene)
        cameras = geometry.look_at(_local(options.position, scene)[None], target)
    elif options.path in PATHS:
        start = OrbitPosition(options.azimuth, options.elevation, options.distance or geometry.distance)
        cameras = path_cameras(geometry, options.path, start, options.frames or 120)
    else:
        file = user_path(str(options.path))
        cameras, seconds = cameras_of_file(file, geometry, scene.source), stated_seconds(file)
        if options.frames is not None:
            cameras = geometry.with_ray_bounds(between_keys(cameras, options.frames))
    seconds = options.seconds or seconds or Shots.seconds
    return Shots(cameras, _numbered("frame", len(cameras), 4), len(cameras) > 1, seconds)


def _local(point: Sequence[float], scene: TrainedScene) -> Float[Tensor, "3"]:
    """Return a point in the coordinates of a scene, which may be relative to another origin."""
    return (torch.tensor(list(point), dtype=torch.float64) - torch.from_numpy(scene.source.origin)).float()


def _views(selection: str, scene: TrainedScene) -> Shots:
    split, _, number = selection.partition(":")
    cameras = scene.cameras(split)
    names = _numbered(split, len(cameras), 3)
    if not number:
        return Shots(cameras, names, False)
    if not number.isdecimal() or int(number) >= len(cameras):
        raise NerfroError(f"views={selection}: {split} has views 0 to {len(cameras) - 1}; give one of these numbers")
    return Shots(cameras.select([int(number)]), [names[int(number)]], False)


def _with_field_of_view(cameras: Cameras, degrees: float) -> Cameras:
    """Change the horizontal field of view of an image whose principal point is in the centre."""
    edge = cameras.fx.new_tensor([math.tan(0.5 * math.radians(degrees)), 0.0]).expand(len(cameras), 2)
    if cameras.distortion is not None:
        fold = fold_radius(cameras.distortion)
        if bool((edge[:, 0] >= fold).any()):
            widest = 2 * math.degrees(math.atan(float(fold.min())))
            raise NerfroError(
                f"fov={degrees:g} is not allowed, because the lens distortion is invertible up to {widest:.0f} "
                "degrees; take less"
            )
        edge, _ = distort(edge, cameras.distortion)
    focal = 0.5 * cameras.width / edge[:, 0]
    return replace(cameras, fx=focal, fy=focal * cameras.fy / cameras.fx)


def _require_invertible(cameras: Cameras, names: Sequence[str]) -> None:
    """Refuse images that are larger than the region in which the lens distortion is invertible."""
    if cameras.distortion is None:
        return
    numbers = torch.stack([cameras.fx, cameras.fy, cameras.cx, cameras.cy], -1).tolist()
    both = zip(numbers, cameras.distortion.tolist(), strict=True)
    lenses = [Lens(fx, fy, cx, cy, tuple(distortion)) for (fx, fy, cx, cy), distortion in both]
    check_lenses(lenses, names, (cameras.width, cameras.height))


def _resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """Change the resolution at constant horizontal field of view, with square pixels."""
    scale = width / cameras.width
    cx, cy = (scale * (c - 0.5 * n) for c, n in ((cameras.cx, cameras.width), (cameras.cy, cameras.height)))
    return replace(
        cameras, width=width, height=height, fx=scale * cameras.fx, fy=scale * cameras.fy,
        cx=cx + 0.5 * width, cy=cy + 0.5 * height,
    )  # fmt: skip


def _size(options: RenderConfig, width: int, height: int) -> tuple[int, int]:
    """Return width and height in pixels."""
    resolution = options.resolution
    sides = list(resolution) if isinstance(resolution, list | tuple) else [resolution]
    if resolution is None:
        return width, height
    if not all(isinstance(side, int) and side > 0 for side in sides) or len(sides) > 2:
        raise NerfroError(f"resolution={resolution} is not allowed; give the width in pixels, or [width,height]")
    return sides[0], sides[1] if len(sides) == 2 else max(1, round(sides[0] * height / width))


def _numbered(word: str, count: int, digits: int) -> list[str]:
    return [f"{word}_{number:0{digits}d}" for number in range(count)]
