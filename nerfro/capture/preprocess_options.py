"""Options of `python -m nerfro.preprocess`, the output folder, and the scene file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float
from omegaconf import MISSING, DictConfig

from nerfro.cli.calls import Composition
from nerfro.cli.overrides import is_given
from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import EMBEDDED_PREFIX, resolve_path, user_path
from nerfro.data.base import DataSource
from nerfro.data.frames import require_root
from nerfro.files.atomic import refuse_existing
from nerfro.geometry.mesh import TriangleMesh, load_mesh, local_origin, num_decimals, subdivided
from nerfro.geometry.space import corners_of_box
from nerfro.media.body_settings import expanded
from nerfro.registry.allowed import Count, Natural, NotNegative, plain, refuse_unused, validate
from nerfro.registry.registration import build
from nerfro.rendering.scene_file import SCENE, SceneFile, take_bodies
from nerfro.silhouettes.agreement import REPORT, SHEET
from nerfro.silhouettes.revolution import Symmetry
from nerfro.silhouettes.upright import find_up

MESH = "mesh.ply"
INDEX, FIGURES = "index.json", "refinement.json"
_OF_HULL = ("resolution", "box_min", "box_max", "keep", "smoothing", "symmetry")


@dataclass
class PreprocessConfig:
    """Options of `python -m nerfro.preprocess`.

    Attributes:
        data: data set (options of the group `data`); the photographs of the training views and the masks of all views
            are used.
        medium: medium that is built from the surface (options of the group `medium`).
        refine: after the search for the index, refine the surface until its refractions match the photographs.
        mesh: known surface, which is compared with the masks; replaces the hull.
        room: whether the surroundings are near; by default, the search for the index decides.
        out: output folder; by default data.root.
        resolution: number of voxels along the longest side of the hull.
        box_min, box_max: corners of the box of the hull, world units; by default estimated from cameras and masks.
        wrong_masks: number of views that may be wrong about any point; null selects the number for which the hull
            agrees best with the masks.
        keep: number of largest separate components to keep; by default all but small ones.
        smoothing: factor of the smoothness of the surface; 0 keeps the carved hull.
        symmetry: fit a body of revolution unless a free surface overlaps more with the masks, by 0.005 (`auto`) or 0.01
            (`axis`).
        vessel: also fit wall, foot and contents of an open vessel to the photographs.
        overwrite: allow replacing existing files.
    """

    data: Any = MISSING
    medium: Any = MISSING
    refine: bool = False
    mesh: str | None = None
    room: bool | None = None
    out: str | None = None
    resolution: Annotated[int, Ge(16), Le(1024)] = 96
    box_min: list[float] | None = None
    box_max: list[float] | None = None
    wrong_masks: Natural | None = 0
    keep: Count | None = None
    smoothing: NotNegative = 1.0
    symmetry: Symmetry | None = None
    vessel: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class Request(Composition):
    """Composed options of `python -m nerfro.preprocess`, see `PreprocessConfig`."""

    @property
    def out(self) -> Path:
        """Output folder."""
        return resolve_path(self.config.data.root) if self.config.out is None else user_path(self.config.out)

    @property
    def box(self) -> Float[np.ndarray, "2 3"] | None:
        """Corners of the box of the hull, if given."""
        corners = self.config.box_min, self.config.box_max
        return None if None in corners else np.array(corners, np.float64)

    @property
    def searches_index(self) -> bool:
        """Whether to search the index. The materials of a vessel are known, and those of named bodies if one is."""
        medium = self.config.medium
        if "wall" in medium:
            return False
        if medium.get("bodies") is not None:
            return not any(body.ior or body.material for body in expanded({"bodies": medium.bodies}).values())
        return not is_given("medium.ior", self.overrides)

    @property
    def files(self) -> list[Path]:
        """Files that the command writes, unless masks are missing or the refinement fails."""
        config = self.config
        names = [MESH] if config.mesh is None or config.refine else []
        names += [SHEET, REPORT]
        names += [INDEX] if self.searches_index else []
        names += [FIGURES] if config.refine else []
        return [self.out / name for name in [*names, SCENE]]

    def clear_files(self) -> None:
        """Refuse existing files, or with `overwrite` remove those of an earlier run that this one may not write.

        Raises:
            NerfroError: a file exists, and `overwrite` is false.
        """
        refuse_existing(self.files, self.config.overwrite)
        for name in (INDEX, FIGURES, SHEET, REPORT) if self.config.overwrite else ():
            (self.out / name).unlink(missing_ok=True)

    def check(self) -> None:
        """Check the options and the output folder.

        Raises:
            NerfroError: options contradict each other, or the output folder cannot be used.
        """
        config = self.config
        if (config.box_min is None) != (config.box_max is None):
            raise NerfroError("the box needs two corners; give both box_min and box_max, or neither")
        if config.box_min is not None:
            corners_of_box(config.box_min, config.box_max)
        if config.mesh is not None:
            options = validate(PreprocessConfig, plain(config))
            refuse_unused(options, _OF_HULL, "with mesh=..., which replaces the hull")
        if config.refine and "shell_voxels" not in config.medium:
            raise NerfroError("refine=true needs a distance grid; set medium=object or medium=vessel")
        if config.vessel and ("shell_voxels" not in config.medium or "wall" in config.medium):
            raise NerfroError("vessel=true estimates the lengths of a vessel; set medium=object, or remove vessel=true")
        if (config.refine or config.vessel) and config.medium.get("bodies") is not None:
            name, first = next(iter(expanded({"bodies": config.medium.bodies}).items()))
            if first.mesh or first.surface:
                raise NerfroError(
                    "refine=true and vessel=true change the first body, which must have the surface that preprocess "
                    f"makes or takes from mesh=, and bodies.{name} has another one; list the body without mesh and "
                    "surface first, and without a priority above the others"
                )
        if config.out is None and str(config.data.root).startswith(EMBEDDED_PREFIX):
            raise NerfroError(f"data.root={config.data.root} is part of nerfro and read-only; add out=FOLDER")
        if config.out is None:
            require_root(self.out)

    def read(self) -> tuple[DataSource, TriangleMesh | None]:
        """Build the data set and read the given mesh, if any, with positions relative to `DataSource.origin`."""
        source: DataSource = build(self.config.data)
        if self.config.mesh is None:
            return source, None
        accept_open_mesh = self.config.medium.get("accept_open_mesh", False)
        mesh = load_mesh(resolve_path(self.config.mesh), accept_open_mesh)
        source = source.with_origin(local_origin(mesh.vertices))
        return source, mesh.relative_to(source.origin)


def surface_settings(
    request: Request, cameras: Cameras, mesh: TriangleMesh, origin: Float[np.ndarray, "3"]
) -> dict[str, object]:
    """Determine the settings of the medium that a surface needs beside the given ones.

    Args:
        request: options of the command.
        cameras: cameras of the photographs.
        mesh: the surface.
        origin: world coordinates of the origin of cameras and mesh.
    """
    settings: dict[str, object] = {}
    names = ("medium.box_min", "medium.box_max", "medium.bodies")  # each of several bodies has a box of its own
    if not any(is_given(name, request.overrides) for name in names):
        # A margin of 15 % of the object's size.
        centre, half_side = mesh.bounds.mean(0) + origin, 0.65 * float(np.ptp(mesh.bounds, axis=0).max())
        digits = max(0, num_decimals(half_side, 7))
        for name, corner in (("box_min", centre - half_side), ("box_max", centre + half_side)):
            settings[name] = [round(float(x), digits) for x in corner]
    is_up_needed = "wall" in request.config.medium and not is_given("medium.up", request.overrides)
    if is_up_needed and (estimate := find_up(cameras, mesh)) is not None:
        up, reason = estimate
        settings["up"] = [round(float(x), 4) for x in up]
        print(f"up is {settings['up']}, {reason}; set medium.up= to change the direction")
    return settings


def _ray_bounds(cameras: Cameras, mesh: TriangleMesh) -> dict[str, object]:
    """Determine bounds of the rays that enclose a surface, where those of the cameras cut it."""
    # Points between the vertices of long edges, because the middle of a face may be the nearest one.
    points = subdivided(mesh, 0.1 * float(np.ptp(mesh.bounds, axis=0).max())).vertices
    centres = cameras.camera_to_world[:, :, 3].double().numpy()
    # By camera, because all distances of a scan would take gigabytes.
    distances = (np.linalg.norm(points - centre, axis=1) for centre in centres)
    limits = np.array([(distance.min(), distance.max()) for distance in distances])
    nearest, farthest = limits[:, 0].min(), limits[:, 1].max()
    bounds: dict[str, object] = {}
    if cameras.near >= nearest:
        bounds["near"] = float(f"{0.8 * nearest:.3g}")
    if cameras.far <= farthest:
        bounds["far"] = float(f"{1.2 * farthest:.3g}")
    return bounds


def index_settings(medium: DictConfig, names: Iterable[str], iors: Iterable[float]) -> dict[str, object]:
    """Return the settings of the medium for the indices of its bodies, given the names of the bodies."""
    values = [round(float(ior), 4) for ior in iors]
    if medium.get("bodies") is None:
        return {"ior": values[0]}
    bodies = plain(medium.bodies)
    return {"bodies": {name: bodies[name] | {"ior": ior} for name, ior in zip(names, values, strict=True)}}


def write_scene(request: Request, estimated: SceneFile, cameras: Cameras, mesh: TriangleMesh) -> SceneFile:
    """Write the scene file, and print the result files.

    Args:
        request: options of the command.
        estimated: estimated values; they have precedence over the options.
        cameras: cameras of the photographs.
        mesh: the surface.

    Returns:
        The content of the scene file.
    """
    medium = request.described("medium") | estimated.medium
    data = request.described("data") | {"root": str(request.config.data.root)} | _ray_bounds(cameras, mesh)
    size = [cameras.width, cameras.height]
    scene = replace(estimated, data=data, bodies=take_bodies(medium), medium=medium, photograph=size)
    scene.save(request.out / SCENE)
    print(f"results: {', '.join(str(file) for file in request.files if file.exists())}")
    return scene
