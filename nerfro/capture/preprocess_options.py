"""What `python -m nerfro.preprocess` can be asked, where it writes, and what it advises next."""

from __future__ import annotations

import json
import shlex
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
from omegaconf import MISSING, DictConfig, OmegaConf

from nerfro.allowed import Count, Natural, NotNegative, Range, corners_of_box
from nerfro.cameras import Cameras
from nerfro.capture.index_report import CURVE, INDEX
from nerfro.capture.overlaps import REPORT, SHEET
from nerfro.capture.refinement_report import FIGURES, PICTURES
from nerfro.capture.revolution import Symmetry
from nerfro.capture.upright import find_up
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.geometry.mesh import TriangleMesh
from nerfro.media.base import Medium
from nerfro.paths import EMBEDDED_PREFIX, resolve_path, user_path
from nerfro.registry import build

MESH, CAMERAS, FOUND = "mesh.ply", "cameras.json", "preprocess.json"
# The medium's grid is this much wider than the object.
_MARGIN_SHARE = 0.15


@dataclass
class PreprocessConfig:
    """What `python -m nerfro.preprocess` is asked.

    Attributes:
        data: the views (options of the group `data`).
        medium: what becomes of the surface (options of the group `medium`).
        refine: whether the surface is moved, after the index was found, until the photographs fit what is seen through
            it.
        refine_cameras: whether poses are refined with the hull, by the sky and the outlines of the masks. The
            surroundings must be far away.
        split: whose masks are used.
        mesh: a surface that was made elsewhere; it is checked against the masks, and no hull is made.
        room: whether the surroundings are near, for the search of the index; by default found out.
        out: folder that the results are written to; by default data.root.
        resolution: voxels along the longest side of the hull.
        box_min, box_max: box that the hull is carved in, world units; by default found from cameras and masks.
        wrong_masks: number of views that may be wrong about any point of space; null for the number with which the
            hull looks most like the masks.
        keep: number of separate parts to keep, the largest; by default all but strays.
        smoothing: how smooth the surface is where the masks leave it open; 0 for the carved hull itself.
        symmetry: axis for what came off a wheel or a lathe: a body of revolution, where that looks like the masks; auto
            to try one, and take it where it looks as much like the masks as the surface that is free.
        overwrite: whether files that exist may be replaced.
    """

    data: Any = MISSING
    medium: Any = MISSING
    refine: bool = False
    refine_cameras: bool = False
    split: str = "train"
    mesh: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    room: Optional[bool] = None  # noqa: UP045
    out: Optional[str] = None  # noqa: UP045
    resolution: Annotated[int, Range(at_least=16, at_most=1024)] = 96
    box_min: Optional[list[float]] = None  # noqa: UP045
    box_max: Optional[list[float]] = None  # noqa: UP045
    wrong_masks: Optional[Natural] = 0  # noqa: UP045
    keep: Optional[Count] = None  # noqa: UP045
    smoothing: NotNegative = 1.0
    symmetry: Annotated[Optional[str], Symmetry] = None  # noqa: UP045
    overwrite: bool = False


def is_given(option: str, overrides: list[str]) -> bool:
    """Whether a command line says what an option is."""
    return option in {text.lstrip("+").split("=")[0] for text in overrides}


def searches_index(config: DictConfig, overrides: list[str]) -> bool:
    """Whether the index is to be found: not that of a vessel, whose materials are known."""
    return not is_given("medium.ior", overrides) and "wall" not in config.medium


def claim(config: DictConfig, overrides: list[str]) -> Path:
    """The folder to write to; refused if it is the package's, or a file is there."""
    if (config.box_min is None) != (config.box_max is None):
        raise NerfroError("give both box_min and box_max, or neither to have the box found")
    if config.box_min is not None:
        corners_of_box(config.box_min, config.box_max)
    if config.refine and "shell_voxels" not in config.medium:
        raise NerfroError("refine=true moves a surface that is a distance; take medium=object or medium=vessel for it")
    if config.refine_cameras and config.room:
        raise NerfroError(
            "refine_cameras=true needs surroundings that are far away, and room=true says that they are not"
        )
    if config.out is None and str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} ships with nerfro and is not written to; add out=FOLDER")
    folder = resolve_path(config.data.root) if config.out is None else user_path(config.out)
    names = [SHEET, REPORT] if config.mesh is not None else [MESH, SHEET, REPORT]
    names += [MESH, FIGURES, PICTURES] if config.refine else []
    names += [CAMERAS] if config.refine_cameras else []
    names += [INDEX, CURVE] if searches_index(config, overrides) else []
    refuse_existing([folder / name for name in [*names, FOUND]], config.overwrite)
    return folder


def surface_settings(
    config: DictConfig, cameras: Cameras, mesh: TriangleMesh, location: str, overrides: list[str]
) -> dict[str, object]:
    """What has to be said beside this command line's overrides, so that medium and data hold the surface.

    The surface's file is its `location`.
    """
    settings: dict[str, object] = {}
    if location != f"{config.data.root}/{MESH}":
        settings["medium.mesh"] = location
    if not (is_given("medium.box_min", overrides) or is_given("medium.box_max", overrides)):
        centre, half_side = mesh.bounds.mean(0), (0.5 + _MARGIN_SHARE) * float(np.ptp(mesh.bounds, axis=0).max())
        digits = max(0, 3 - int(np.floor(np.log10(half_side))))
        for name, corner in (("box_min", centre - half_side), ("box_max", centre + half_side)):
            settings[f"medium.{name}"] = [round(float(x), digits) for x in corner]
    offsets = cameras.camera_to_world[:, None, :, 3].double().numpy() - mesh.vertices[::16]
    distance = np.linalg.norm(offsets, axis=-1)
    if cameras.near >= distance.min():
        settings["data.near"] = float(f"{0.8 * distance.min():.3g}")
    if cameras.far <= distance.max():
        settings["data.far"] = float(f"{1.2 * distance.max():.3g}")
    if "wall" in config.medium and not is_given("medium.up", overrides):
        settings |= _up_settings(cameras, mesh)
    return settings


def _up_settings(cameras: Cameras, mesh: TriangleMesh) -> dict[str, object]:
    """What has to be said so that a vessel stands upright in a world whose z points elsewhere; it is printed too."""
    found = find_up(cameras, mesh)
    if found is None:
        return {}
    up, told = found
    given = [round(float(x), 4) for x in up]
    print(f"up is {given}, {told}; medium.up= says it otherwise")
    return {"medium.up": given}


def build_medium(config: DictConfig, settings: dict[str, object], location: str, numbers: dict[str, object]) -> Medium:
    """The medium with the surface and some numbers in it, so that a bad one is refused now and not in training."""
    medium = typing.cast(dict[str, object], OmegaConf.to_container(config.medium, resolve=True))
    medium |= {name.removeprefix("medium."): value for name, value in settings.items() if name.startswith("medium.")}
    return typing.cast(Medium, build(medium | {"mesh": location} | numbers))


def index_settings(iors: Sequence[float]) -> dict[str, object]:
    """The medium's options that give its bodies these indices."""
    first, *inner = (round(float(ior), 4) for ior in iors)
    return {"ior": first} | ({"inner_iors": inner} if inner else {})


def train_command(settings: dict[str, object], overrides: list[str]) -> list[str]:
    """The command that trains with these settings and what this command line said of data and medium."""
    kept = [text for text in overrides if text.lstrip("+").startswith(("data=", "data.", "medium=", "medium."))]
    kept = [text for text in kept if text.lstrip("+").split("=")[0] not in {*settings, "medium.mesh"}]
    return ["python", "-m", "nerfro.train", *kept, *_written(settings)]


def conclude(
    folder: Path,
    written: Sequence[str],
    settings: dict[str, object],
    overrides: list[str],
    doubtful: dict[str, object],
    near: bool | None,
    cameras: Cameras,
) -> None:
    """Write preprocess.json, what training needs to know, and print what was written and what comes next.

    Args:
        folder: to write to.
        written: names of the files that are there already.
        settings: that the next command has beside the overrides.
        overrides: of this command line.
        doubtful: settings that are left out, because the photographs do not tell them, with what fits best.
        near: whether the surroundings are near, if that was found out.
        cameras: of the photographs.
    """
    command = train_command(settings, overrides)
    found = {
        "options": command[3:],
        "doubtful": _written(doubtful),
        "near": near,
        "pixels": [cameras.width, cameras.height],
    }
    write_atomically(folder / FOUND, json.dumps(found, indent=1) + "\n")
    print(f"wrote {', '.join(str(folder / name) for name in [*written, FOUND])}")
    if doubtful:
        print(f"give {' '.join(f'{option}=N' for option in doubtful)} yourself")
    print("where the surroundings are near, add +experiment=refractive_room; the baseline is +experiment=mipnerf")
    print(f"train on it: {shlex.join(command)}")


def _written(settings: dict[str, object]) -> list[str]:
    return [f"{name}={str(value).replace(' ', '')}" for name, value in settings.items()]
