"""`python -m nerfro.preprocess data.root=DIR medium.ior=1.33`: an object's surface from its silhouettes."""

from __future__ import annotations

import json
import shlex
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
import trimesh
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from omegaconf import MISSING, DictConfig, OmegaConf
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from nerfro.capture.overlays import contact_sheet
from nerfro.capture.pose_conventions import GOOD_OVERLAP, overlap, require_consistent_poses
from nerfro.capture.silhouette_fit import fit_surface
from nerfro.capture.visual_hull import (
    Silhouettes,
    carve_grid,
    extract_surface,
    find_box,
    reached_sides,
    remove_strays,
)
from nerfro.cli import entry_point
from nerfro.data.base import Views
from nerfro.errors import NerfroError, first_of
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.files.images import save_png
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.paths import EMBEDDED_PREFIX, resolve_path
from nerfro.registry import build

_MESH, _SHEET, _REPORT = "mesh.ply", "overlays.png", "overlaps.json"
_FEWEST_VIEWS, _FEW_VIEWS = 3, 12
_COARSE_VOXELS = 64
# The object's box is found to this many coarse voxels; the medium's grid is this much wider than the object.
_MARGIN_VOXELS, _MARGIN_SHARE = 2, 0.15
_MAX_PIXELS = 256
# Cameras whose directions to the object lie within this angle see it from one side, degrees.
_ONE_SIDE = 75.0


@dataclass
class PreprocessConfig:
    """What `python -m nerfro.preprocess` is asked.

    Attributes:
        data: the views (options of the group `data`).
        medium: what becomes of the surface (options of the group `medium`).
        split: whose masks are used.
        mesh: a surface that was made elsewhere; it is checked against the masks, and no hull is made.
        out: folder that mesh.ply, overlays.png and overlaps.json are written to; by default data.root.
        resolution: voxels along the longest side of the hull.
        box_min, box_max: box that the hull is carved in, world units; by default found from cameras and masks.
        wrong_masks: number of views that may be wrong about any point of space.
        keep: number of separate parts to keep, the largest; by default all but strays.
        smoothing: how smooth the surface is where the masks leave it open; 0 for the carved hull itself.
        overwrite: whether files that exist may be replaced.
    """

    data: Any = MISSING
    medium: Any = MISSING
    split: str = "train"
    mesh: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    out: Optional[str] = None  # noqa: UP045
    resolution: int = 96
    box_min: Optional[list[float]] = None  # noqa: UP045
    box_max: Optional[list[float]] = None  # noqa: UP045
    wrong_masks: int = 0
    keep: Optional[int] = None  # noqa: UP045
    smoothing: float = 1.0
    overwrite: bool = False


@entry_point("preprocess", PreprocessConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Carve, fit, compare with the masks, and say how to train; whatever can be refused is refused before that."""
    supplied = None if config.mesh is None else load_mesh(resolve_path(config.mesh))
    folder = _claim(config)
    source = build(config.data)
    views = source.load(config.split)
    silhouettes = read_silhouettes(views, config.box_min is not None)
    require_consistent_poses(silhouettes, views.names, config.wrong_masks)
    mesh = make_mesh(config, silhouettes) if supplied is None else supplied
    overlaps = overlap(mesh, silhouettes, _MAX_PIXELS)
    _report(overlaps, views.names)
    # Pictures and figures first: they help to find out what is wrong with a mesh that the medium then refuses.
    save_png(folder / _SHEET, contact_sheet(views, mesh, overlaps, _MAX_PIXELS))
    each = dict(zip(views.names, (round(float(x), 4) for x in overlaps), strict=True))
    figures = {"split": config.split, "mean": round(float(overlaps.mean()), 4), "views": each}
    write_atomically(folder / _REPORT, json.dumps(figures, indent=1) + "\n")
    location = config.mesh
    if supplied is None:
        location = str(folder / _MESH)
        write_atomically(folder / _MESH, _ply(mesh))
    print(
        f"wrote {', '.join(str(folder / name) for name in ([_MESH] if supplied is None else []) + [_SHEET, _REPORT])}"
    )
    command = train_command(config, silhouettes, mesh, location, list(HydraConfig.get().overrides.task))
    print("where the surroundings are near, add +experiment=refractive_room; the baseline is +experiment=mipnerf")
    print(f"train on it: {shlex.join(command)}")


def _claim(config: DictConfig) -> Path:
    """The folder to write to.

    Raises:
        NerfroError: an option is out of range, the folder is the package's, or a file would be replaced.
    """
    if not 16 <= config.resolution <= 1024:
        raise NerfroError(f"resolution={config.resolution} is not allowed; take 16 to 1024 voxels a side")
    if config.wrong_masks < 0 or (config.keep is not None and config.keep < 1) or not config.smoothing >= 0:
        raise NerfroError(
            f"wrong_masks={config.wrong_masks}, keep={config.keep}, smoothing={config.smoothing} are not allowed; "
            "wrong_masks and smoothing start at 0, keep at 1"
        )
    if (config.box_min is None) != (config.box_max is None):
        raise NerfroError("give both box_min and box_max, or neither to have the box found")
    if config.box_min is not None and (
        len(config.box_min) != 3 or len(config.box_max) != 3 or not (np.array(config.box_min) < config.box_max).all()
    ):
        raise NerfroError(f"box_min={config.box_min}, box_max={config.box_max} is no box; give three numbers each")
    if config.out is None and str(config.data.root).startswith(EMBEDDED_PREFIX):
        raise NerfroError(f"data.root={config.data.root} ships with nerfro and is not written to; add out=FOLDER")
    folder = resolve_path(config.data.root) if config.out is None else Path(config.out).expanduser()
    names = [_SHEET, _REPORT] if config.mesh is not None else [_MESH, _SHEET, _REPORT]
    refuse_existing([folder / name for name in names], config.overwrite)
    return folder


def read_silhouettes(views: Views, has_box: bool) -> Silhouettes:
    """The outlines of views, checked.

    Args:
        views: with masks.
        has_box: whether the user has given a box that bounds what the masks do not.

    Raises:
        NerfroError: there are no masks or too few views, masks are empty, full or inverted, or all are cut.
    """
    if views.masks is None:
        raise NerfroError(
            "the data has no masks, and the hull is made of them; docs/capture.md tells where they are looked for "
            "and how to make them"
        )
    inside = views.masks > 0.5
    share = inside.flatten(1).float().mean(1)
    for wrong, what in ((share == 0, "empty"), (share == 1, "all object")):
        if wrong.any():
            raise NerfroError(
                f"{_names(views, wrong)}: the mask is {what}; draw it (object white, everything else black), "
                "or take the view out"
            )
    border = torch.cat([inside[:, [0, -1]].flatten(1), inside[:, :, [0, -1]].flatten(1)], 1).float().mean(1)
    # The frame is object and the rest is not: true of no photograph of an object, let alone of most.
    inverted = (border > 0.9) & (share < 1)
    if inverted.float().mean() > 0.5:
        raise NerfroError(
            f"{int(inverted.sum())} of {len(views)} masks cover the frame of their image and leave the inside: "
            "they are inverted; save them with the object white and everything else black"
        )
    if len(views) < _FEWEST_VIEWS:
        raise NerfroError(
            f"{len(views)} views do not bound a shape; give masks of {_FEWEST_VIEWS} or more, better 30 from all sides"
        )
    if len(views) < _FEW_VIEWS:
        _warn(f"{len(views)} views make a coarse hull; 30 from all sides make a good one")
    silhouettes = Silhouettes.of(views.cameras, views.masks)
    if silhouettes.cut.all() and not has_box:
        raise NerfroError(
            f"the object is cut by the frame in all {len(views)} views, so that it has no whole outline; "
            "photograph it from farther away, or give box_min= and box_max= to cut the hull there"
        )
    if silhouettes.cut.any():
        _warn(f"{_names(views, silhouettes.cut)}: the frame cuts the object; nothing is known beyond it")
    return silhouettes


def make_mesh(config: DictConfig, silhouettes: Silhouettes) -> TriangleMesh:
    """Carve the hull and fit a smooth surface into it."""
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as progress:
        if config.box_min is None:
            box = _object_box(silhouettes, config.wrong_masks)
        else:
            box = np.array([config.box_min, config.box_max], np.float64)
        carving = progress.add_task("carving", total=3)
        distances, corner, spacing = carve_grid(
            silhouettes,
            box,
            config.resolution,
            config.wrong_masks,
            lambda done: progress.update(carving, completed=done),
        )
        num_parts, num_kept = remove_strays(distances, config.keep)
        mesh = extract_surface(distances, corner, spacing)
        if config.smoothing > 0:
            fitting = progress.add_task("fitting", total=1)
            mesh = fit_surface(
                mesh, silhouettes, config.smoothing, lambda done: progress.update(fitting, completed=done)
            )
    if num_kept < num_parts:
        print(f"{num_kept} of {num_parts} separate parts kept, the largest")
    if reached_sides(distances):
        _warn_of_open_hull(silhouettes, box)
    print(f"{len(mesh.faces)} triangles, voxels of {spacing:.4g}")
    return mesh


def _object_box(silhouettes: Silhouettes, wrong_masks: int) -> Float[np.ndarray, "2 3"]:
    """Bounds of a coarse hull, with a margin."""
    box = find_box(silhouettes, wrong_masks)
    distances, corner, spacing = carve_grid(silhouettes, box, _COARSE_VOXELS, wrong_masks)
    remove_strays(distances)
    inside = np.argwhere(distances < 0)
    low, high = inside.min(0) - _MARGIN_VOXELS, inside.max(0) + _MARGIN_VOXELS
    return np.stack([corner + spacing * low, corner + spacing * high]).clip(*box)


def _warn_of_open_hull(silhouettes: Silhouettes, box: Float[np.ndarray, "2 3"]) -> None:
    towards = silhouettes.cameras.camera_to_world[:, :, 3] - torch.from_numpy(box.mean(0)).float()
    towards = torch.nn.functional.normalize(towards, dim=-1)
    spread = float(torch.rad2deg(torch.arccos((towards @ towards.T).clamp(-1, 1))).max())
    if spread < _ONE_SIDE:
        reason = (
            f"all cameras look from within {spread:.0f} degrees, and no silhouette shows where the object ends in depth"
        )
    else:
        reason = "the masks that would bound it are cut by their frames, or the box is too small"
    _warn(f"the hull is cut off by the box {np.round(box, 3).tolist()}: {reason}; give box_min= and box_max= to set it")


def _report(overlaps: Float[np.ndarray, "V"], names: list[str]) -> None:
    print("overlap (intersection over union) of the surface's silhouette with each mask:")
    for name, value in zip(names, overlaps, strict=True):
        print(f"  {value:.4f}  {name}")
    worst = int(overlaps.argmin())
    print(f"  {overlaps.mean():.4f}  mean; {overlaps[worst]:.4f} lowest, {names[worst]}")
    bad = [names[view] for view in np.argsort(overlaps, kind="stable") if overlaps[view] < GOOD_OVERLAP]
    if bad:
        _warn(f"overlaps below {GOOD_OVERLAP}: {first_of(bad)}; look at {_SHEET}, and correct their masks or poses")


def train_command(
    config: DictConfig, silhouettes: Silhouettes, mesh: TriangleMesh, location: str, overrides: list[str]
) -> list[str]:
    """The command that trains on the surface; makes the index grid, so that a bad one is refused now and not then.

    Args:
        config: of this run.
        silhouettes: of the views.
        mesh: the surface.
        location: its file.
        overrides: what the user has given on the command line.

    Raises:
        NerfroError: the medium refuses the mesh or an option.
    """
    given = {key.lstrip("+").split("=")[0] for key in overrides}
    settings = {"medium.ior": config.medium.ior}
    if location != f"{config.data.root}/{_MESH}":
        settings["medium.mesh"] = location
    if not {"medium.box_min", "medium.box_max"} & given:
        centre, half_side = mesh.bounds.mean(0), (0.5 + _MARGIN_SHARE) * float(np.ptp(mesh.bounds, axis=0).max())
        digits = max(0, 3 - int(np.floor(np.log10(half_side))))
        for name, corner in (("box_min", centre - half_side), ("box_max", centre + half_side)):
            settings[f"medium.{name}"] = [round(float(x), digits) for x in corner]
    offsets = silhouettes.cameras.camera_to_world[:, None, :, 3].double().numpy() - mesh.vertices[::16]
    distance = np.linalg.norm(offsets, axis=-1)
    if silhouettes.cameras.near >= distance.min():
        settings["data.near"] = float(f"{0.8 * distance.min():.3g}")
    if silhouettes.cameras.far <= distance.max():
        settings["data.far"] = float(f"{1.2 * distance.max():.3g}")
    medium = typing.cast(dict[str, object], OmegaConf.to_container(config.medium, resolve=True))
    medium |= {name.removeprefix("medium."): value for name, value in settings.items() if name.startswith("medium.")}
    build(medium | {"mesh": location})
    kept = [text for text in overrides if text.lstrip("+").startswith(("data=", "data.", "medium=", "medium."))]
    kept = [text for text in kept if text.lstrip("+").split("=")[0] not in {*settings, "medium.mesh"}]
    written = [f"{name}={str(value).replace(' ', '')}" for name, value in settings.items()]
    return ["python", "-m", "nerfro.train", *kept, *written]


def _ply(mesh: TriangleMesh) -> bytes:
    return trimesh.exchange.ply.export_ply(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))


def _names(views: Views, chosen: torch.Tensor) -> str:
    return first_of([name for name, wanted in zip(views.names, chosen.tolist(), strict=True) if wanted])


def _warn(message: str) -> None:
    print(f"nerfro: warning: {message}")


if __name__ == "__main__":
    main()
