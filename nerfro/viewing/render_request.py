"""What `python -m nerfro.render` can be asked, and the cameras and scenes that it is asked for."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Optional

import torch
from omegaconf import MISSING, DictConfig, ListConfig

from nerfro.allowed import Count, Positive, Range
from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.paths import user_path
from nerfro.subdivision import SubdivisionChanges
from nerfro.variants import variant
from nerfro.viewing.camera_files import read_cameras
from nerfro.viewing.camera_paths import PATHS, Flight, Surroundings, fly
from nerfro.viewing.layers import LAYERS
from nerfro.viewing.trained_scene import TrainedScene

FILMS = ("mp4", "gif")
Angle = Annotated[float, Range(more_than=0, less_than=180)]


@dataclass
class RenderConfig:
    """What `python -m nerfro.render` is asked: cameras by one of `path`, `views` and `position`."""

    checkpoint: Any = MISSING  # run folder or a checkpoint in it; several in brackets are shown side by side
    path: Optional[str] = None  # around the object: orbit, spiral, arc or dolly; or FILE.json of cameras
    frames: Count = 120  # of the film
    seconds: Positive = 5.0  # that the film lasts
    # Where the path begins: degrees around the object and above it, and world units from its middle.
    azimuth: float = 0.0
    elevation: Annotated[float, Range(at_least=-90, at_most=90)] = 10.0
    distance: Optional[Positive] = None  # by default the photographs'
    views: Optional[str] = None  # cameras of a split of the data, as `test`, or one of them, as `test:3`
    # A still: where the camera is and what it looks at, by default the object's middle; world units.
    position: Optional[list[float]] = None
    target: Optional[list[float]] = None
    fov: Optional[Angle] = None  # horizontal field of view, degrees; by default the photographs'
    resolution: Any = None  # pixels across, or [width, height]; by default the photographs'
    # What is shown: rgb, depth, normals, opacity, exits, glass (nothing inside), inside (no glass), or sky alone.
    what: str = "rgb"
    sky: Optional[str] = None  # lat-long picture that replaces the sky (.hdr, .exr, .png, .jpg)
    # Something that changes from the first frame to the last: medium.ior:1.0:1.6, or sky:a.hdr,b.hdr.
    sweep: Optional[str] = None
    # Which pixels get several rays (see docs/experiments.md); as trained by default.
    subdivision: SubdivisionChanges = dataclasses.field(default_factory=SubdivisionChanges)
    chunk_size: Optional[Count] = None  # rays rendered at once, which bounds the memory; as trained by default
    out: str = MISSING  # folder of the frames and films; an interrupted rendering goes on where it was
    format: str = "png"  # of the frames; exr for values as they are: linear radiance, world units, unit vectors
    film: list[str] = dataclasses.field(default_factory=lambda: ["mp4"])  # mp4, gif, both or none of them
    labels: Optional[list[str]] = (
        None  # written above pictures that are side by side; by default the run folders' names
    )
    root: Optional[str] = None  # folder of the data, if it has moved since training
    device: str = "auto"  # `cpu`, `cuda`, or `auto` for a GPU if there is one
    overwrite: bool = False  # whether other frames in `out` may be replaced


@dataclass(frozen=True)
class Shots:
    """Cameras in the order of the frames, and the frames' names."""

    cameras: Cameras
    names: list[str]
    film: bool  # whether the frames follow each other in time

    def over_time(self, frames: int) -> Shots:
        """One camera that stays for many frames, where something else changes; more than one as they are."""
        if len(self.cameras) > 1:
            return Shots(self.cameras, self.names, True)
        return Shots(self.cameras.select([0] * frames), _numbered("frame", frames, 4), True)


def check_request(config: DictConfig) -> None:
    """Refuse options that contradict each other, before anything is loaded."""
    given = [name for name in ("path", "views", "position") if config[name] is not None]
    if len(given) != 1:
        raise NerfroError(
            "from where is it seen? give one of path=orbit, path=FILE.json, views=test, and position=[X,Y,Z]"
        )
    for name, allowed in (("what", tuple(LAYERS)), ("format", ("png", "exr"))):
        if config[name] not in allowed:
            raise NerfroError(f"{name}={config[name]} is not allowed; choose one of {', '.join(allowed)}")
    unknown = [name for name in config.film if name not in FILMS]
    if unknown:
        raise NerfroError(f"film={list(config.film)} is not allowed; give some of {', '.join(FILMS)}, or []")
    for name in ("position", "target"):
        point = config[name]
        if point is not None and (len(point) != 3 or not all(map(math.isfinite, point))):
            raise NerfroError(f"{name}={list(point)} is no point; give three numbers")
    if config.target is not None and config.position is None:
        raise NerfroError(f"target={list(config.target)} is for a still; give position=[X,Y,Z] too, or leave it out")
    if config.path is not None and config.path not in PATHS and not config.path.endswith(".json"):
        raise NerfroError(f"path={config.path} is not known; give {', '.join(PATHS)}, or a FILE.json of cameras")
    if config.format == "exr" and len(checkpoints(config)) > 1:
        raise NerfroError("labels are no radiance: pictures side by side are written as format=png")
    if config.labels is not None and len(config.labels) != len(checkpoints(config)):
        raise NerfroError(f"{len(config.labels)} labels for {len(checkpoints(config))} runs; give one for each")
    _size(config, 1, 1)


def checkpoints(config: DictConfig) -> list[str]:
    """The runs that are shown side by side."""
    given = config.checkpoint
    return [str(path) for path in given] if isinstance(given, ListConfig) else [str(given)]


def labels(config: DictConfig) -> list[str]:
    """What is written above each of several pictures: what was given, or the names of the runs' folders."""
    paths = [user_path(path) for path in checkpoints(config)]
    return list(config.labels or [path.name if path.is_dir() else path.absolute().parent.parent.name for path in paths])


def prepared(config: DictConfig, scene: TrainedScene) -> TrainedScene:
    """A loaded scene as it is to be rendered: rays a pixel and at once, and its sky."""
    changes = {name: value for name, value in config.subdivision.items() if value is not None}
    subdivision = replace(scene.subdivision, **changes)
    renderer = variant(scene.renderer, chunk_size=config.chunk_size or scene.renderer.chunk_size)
    scene = replace(scene, renderer=renderer, subdivision=subdivision)
    return scene if config.sky is None else scene.with_(sky=config.sky)


def find_shots(config: DictConfig, scene: TrainedScene) -> Shots:
    """The cameras that are asked for, at their resolution."""
    shots = _views(config.views, scene) if config.views is not None else _flight(config, scene)
    cameras = shots.cameras
    if config.fov is not None:
        focal = torch.full_like(cameras.fx, 0.5 * cameras.width / math.tan(0.5 * math.radians(config.fov)))
        cameras = replace(cameras, fx=focal, fy=focal * cameras.fy / cameras.fx)
    shots = replace(shots, cameras=_sized(cameras, *_size(config, cameras.width, cameras.height)))
    return shots if config.sweep is None else shots.over_time(config.frames)


def _flight(config: DictConfig, scene: TrainedScene) -> Shots:
    """A still, or a path around the object or of a file."""
    around = Surroundings.of(scene.cameras("train"), scene.bounds)
    if config.position is not None:
        target = around.centre if config.target is None else torch.tensor(list(config.target))
        cameras = around.looking(torch.tensor([list(config.position)]), target)
    elif config.path in PATHS:
        start = Flight(config.azimuth, config.elevation, config.distance or around.distance)
        cameras = fly(around, config.path, start, config.frames)
    else:
        cameras = read_cameras(user_path(config.path), around)
    return Shots(cameras, _numbered("frame", len(cameras), 4), len(cameras) > 1)


def _views(given: str, scene: TrainedScene) -> Shots:
    split, _, number = given.partition(":")
    cameras = scene.cameras(split)
    names = _numbered(split, len(cameras), 3)
    if not number:
        return Shots(cameras, names, False)
    if not number.isdecimal() or int(number) >= len(cameras):
        raise NerfroError(f"views={given}: {split} has views 0 to {len(cameras) - 1}; give one of these numbers")
    return Shots(cameras.select([int(number)]), [names[int(number)]], False)


def _sized(cameras: Cameras, width: int, height: int) -> Cameras:
    """Cameras of another resolution: as wide an angle, square pixels, and more or less of it above and below."""
    scale = width / cameras.width
    cx, cy = (scale * (c - 0.5 * n) for c, n in ((cameras.cx, cameras.width), (cameras.cy, cameras.height)))
    return replace(
        cameras, width=width, height=height, fx=scale * cameras.fx, fy=scale * cameras.fy,
        cx=cx + 0.5 * width, cy=cy + 0.5 * height,
    )  # fmt: skip


def _size(config: DictConfig, width: int, height: int) -> tuple[int, int]:
    """Width and height in pixels."""
    given = config.resolution
    sides = list(given) if isinstance(given, ListConfig) else [given]
    if given is None:
        return width, height
    if not all(isinstance(side, int) and side > 0 for side in sides) or len(sides) > 2:
        raise NerfroError(f"resolution={given} is not allowed; give pixels across, or [width,height]")
    return sides[0], sides[1] if len(sides) == 2 else max(1, round(sides[0] * height / width))


def _numbered(word: str, count: int, digits: int) -> list[str]:
    return [f"{word}_{number:0{digits}d}" for number in range(count)]
