"""What a trained scene can be written as, and what is asked about it."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from omegaconf import MISSING, DictConfig

from nerfro.allowed import Count, Positive
from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.cache import save_arrays
from nerfro.files.lat_long import save_lat_long
from nerfro.viewing.meshes import write_mesh
from nerfro.viewing.mitsuba_scene import files_beside, write_mitsuba
from nerfro.viewing.page import page_of
from nerfro.viewing.points import write_points
from nerfro.viewing.trained_scene import SKY_HEIGHT, TrainedScene
from nerfro.viewing.volume import RESOLUTION, bake, find_half_depth


@dataclass
class ExportConfig:
    """What `python -m nerfro.export` is asked."""

    checkpoint: str = MISSING  # run folder, or a checkpoint in it
    what: str = MISSING  # page, mesh, points, sky, volume or mitsuba
    out: str = MISSING  # file that is written; its ending says in which format
    # Grid vertices along the longest side of the inside, or rows of the sky.
    resolution: Optional[Count] = None
    # Inside is solid where half the light is lost within this length, world units; by default a hundredth of the
    # object's longest side.
    half_depth: Optional[Positive] = None
    count: Count = 200_000  # of points
    sky: Optional[str] = None  # lat-long picture that replaces the sky (.hdr, .exr, .png, .jpg)
    root: Optional[str] = None  # folder of the data, if it has moved since training
    device: str = "auto"  # `cpu`, `cuda`, or `auto` for a GPU if there is one
    overwrite: bool = False  # whether `out`, and what lies beside it, may be replaced


@dataclass(frozen=True)
class Export:
    """One kind of file."""

    suffixes: tuple[str, ...]  # of the file's name
    write: Callable[[TrainedScene, Path, DictConfig], str]  # writes the file and says in a few words what it holds
    files: Callable[[Path], list[Path]] = lambda out: [out]  # all that it writes


def find_export(what: str, out: Path) -> Export:
    """The writer of what is asked for.

    Raises:
        NerfroError: it is unknown, or the file's name does not end as such files do.
    """
    if what not in EXPORTS:
        raise NerfroError(f"what={what} is not known; choose {', '.join(EXPORTS)}")
    export = EXPORTS[what]
    if out.suffix.lower() not in export.suffixes:
        raise NerfroError(f"out={out} must end in {' or '.join(export.suffixes)}, for that is what is written")
    return export


def _mesh(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    return write_mesh(scene, out, config.resolution or RESOLUTION, find_half_depth(scene, config.half_depth))


def _points(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    return write_points(scene, out, config.count)


def _sky(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    sky = scene.sky_of_height(config.resolution or SKY_HEIGHT)
    save_lat_long(out, sky)
    return f"the sky: {sky.shape[1]}x{sky.shape[0]} pixels, lat-long, z up"


def _volume(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    volume = bake(scene, config.resolution or RESOLUTION)
    save_arrays(out, {name: getattr(volume, name).numpy() for name in ("density", "rgb", "box")})
    return f"the inside: {'x'.join(map(str, volume.density.shape))} vertices with density and linear rgb"


def _mitsuba(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    return write_mitsuba(scene, out, config.resolution or RESOLUTION, find_half_depth(scene, config.half_depth))


def _page(scene: TrainedScene, out: Path, config: DictConfig) -> str:
    page = page_of(scene, config.resolution or RESOLUTION)
    write_atomically(out, page)
    return f"an interactive page of {len(page) / 1e6:.1f} MB"


EXPORTS = {
    "page": Export((".html",), _page),
    "mesh": Export((".glb", ".ply"), _mesh),
    "points": Export((".ply",), _points),
    "sky": Export((".hdr", ".exr", ".png"), _sky),
    "volume": Export((".npz",), _volume),
    "mitsuba": Export((".xml",), _mitsuba, files_beside),
}
