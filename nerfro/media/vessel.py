"""A vessel that contains a liquid: nested bodies made from one outer surface and a few lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.geometry.bodies import bodies_of
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import area_vectors
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.body_settings import SHADING, BodySettings, expanded, make_material
from nerfro.media.distance_grid import DistanceGrid
from nerfro.media.material import Learns, Material, learned_quantities
from nerfro.media.surfaces import CreaseAngle, Grid, MeshSurface, Shading, Surface, cached_distances, direction
from nerfro.registry.allowed import Coordinate, NotNegative, Positive, Resolution
from nerfro.registry.registration import register


@dataclass(frozen=True)
class VesselLengths:
    """Lengths of a vessel. Heights are measured upwards from the lowest point.

    Attributes:
        wall: thickness of the wall.
        foot: thickness of the bottom.
        fillet: radius of the rounded edge between wall and foot inside the vessel.
        level: height of the liquid; None for a vessel without a surface of a liquid.
        unit: unit of the other lengths, in world units.
    """

    wall: float
    foot: float
    fillet: float = 0.0
    level: float | None = None
    unit: float = 1.0

    def require_within(self, height: float) -> None:
        """Refuse heights that contradict each other or the height of the outer surface in world units."""
        heights = {"foot": self.foot} | ({} if self.level is None else {"level": self.level})
        top = height / self.unit
        if not 0 < self.foot < heights.get("level", top) <= top * (1 + 1e-12):
            settings = " and ".join(f"medium.{name}={value:g}" for name, value in heights.items())
            raise NerfroError(
                f"{settings} is not allowed: heights are measured from the vessel's lowest point, the foot is below "
                f"the level, and the vessel is {top:.4g} high, in world units or the unit of medium.height="
            )


def vessel(
    outer: MeshSurface,
    lengths: VesselLengths,
    glass: Material,
    liquid: Material | None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    closed: bool = False,
    grid: GridSettings = GridSettings(),
) -> Bodies:
    """Make a wall of glass around a cavity that contains a liquid up to a level, and air above the liquid.

    The bodies are nested. The outer body is the wall. The cavity is the part of the outer body deeper than the wall
    and above the foot. The liquid is the part of the cavity below the level. Liquid therefore touches glass without a
    gap. A vessel with a liquid and without a level is full. The wall may be much thinner than a voxel, because each of
    its surfaces is a smooth distance field.

    Args:
        outer: outer surface of the vessel with its opening closed, as silhouettes show it.
        lengths: lengths of the vessel.
        glass: material of the wall.
        liquid: material of the liquid; None for an empty vessel.
        up: direction from the bottom to the top, world axes; its length does not matter.
        closed: whether the wall continues over the top. Otherwise the part of the outer surface at the top that faces
            up is an opening.
        grid: settings of the grids.

    Raises:
        NerfroError: the heights contradict each other, or wall and foot leave no cavity.
    """
    upwards = direction("medium.up", up)
    low, high = extent(outer, upwards)
    lengths.require_within(high - low)
    lid = None if closed else find_lid(outer.mesh, upwards)
    cavity = _Cavity(outer, lid, lengths, upwards, low)
    wall = Body("wall", outer, glass)
    if liquid is None:
        inside = [Body("air", cavity, Material(1.0))]
    elif lengths.level is None:
        inside = [Body("liquid", cavity, liquid)]
    else:
        level = _Level(outer, upwards, low + lengths.level * lengths.unit)
        inside = [Body("air", cavity, Material(1.0)), Body("liquid", level, liquid)]
    medium = Bodies([wall, *inside], nested=True, grid=grid)
    _require_cavity(medium, lengths)
    return medium


def _require_cavity(medium: Bodies, lengths: VesselLengths) -> None:
    within, cavity = medium.grids[0].distances < 0, medium.grids[1]
    assert isinstance(cavity, CavityGrid)
    if not (within & (cavity.distances < 0)).any():
        deepest = -float(cavity.side[within].min()) / lengths.unit
        raise NerfroError(
            f"medium.wall={lengths.wall:g} and medium.foot={lengths.foot:g} leave no cavity: no point of the body is "
            f"deeper than {deepest:.3g}; give smaller ones, in world units, or medium.height= in the same unit"
        )


def extent(outer: MeshSurface, up: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return the lowest and the highest coordinate of a surface along a direction, world units."""
    heights = outer.mesh.vertices @ up
    return float(heights.min()), float(heights.max())


def with_lengths(medium: Bodies, lengths: VesselLengths) -> Bodies:
    """Return a vessel with other lengths; twice the wall plus the fillet is at most that of the original."""
    outer, cavity, *levels = medium.grids
    assert isinstance(cavity, CavityGrid)
    grids = [outer, CavityGrid(cavity.side, cavity.heights, lengths, cavity.box)]
    if levels and lengths.level is not None:
        grids.append(DistanceGrid(cavity.heights - lengths.level * lengths.unit, cavity.box))
    return medium.with_grids(grids)


def find_lid(mesh: TriangleMesh, up: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "F"]:
    """Find the lid of a mesh: the connected level triangles around the highest level triangle.

    Triangles count as level if their normals are within 45 degrees of up.

    Args:
        mesh: outer surface of the vessel.
        up: unit vector.

    Returns:
        Whether each triangle belongs to the lid; false everywhere if no triangle is level.
    """
    triangles = mesh.triangles
    normals = area_vectors(triangles)
    level = normals @ up > np.cos(np.pi / 4) * np.linalg.norm(normals, axis=-1)
    if not level.any():
        return level
    component = bodies_of(TriangleMesh(mesh.vertices, mesh.faces[level]))
    highest = (triangles[level].mean(1) @ up).argmax()
    lid = np.zeros_like(level)
    lid[level] = component == component[highest]
    return lid


class CavityGrid(DistanceGrid):
    """Signed distance of the cavity of a vessel.

    Args:
        side: signed distances to the outer surface without its lid, world units.
        heights: heights of the vertices above the lowest point, world units.
        lengths: lengths of the vessel.
        box: lower and upper corner of the grid, world units.
    """

    side: Float[Tensor, "X Y Z"]
    heights: Float[Tensor, "X Y Z"]

    def __init__(
        self,
        side: Float[Tensor, "X Y Z"],
        heights: Float[Tensor, "X Y Z"],
        lengths: VesselLengths,
        box: Float[Tensor, "2 3"],
    ) -> None:
        wall, foot, fillet = (length * lengths.unit for length in (lengths.wall, lengths.foot, lengths.fillet))
        inwards, base = side + wall, foot - heights
        # In the corner, the distance is that to a circle that touches wall and foot.
        in_corner = (inwards > -fillet) & (base > -fillet) & (fillet > 0)
        circle = torch.hypot(inwards + fillet, base + fillet) - fillet
        super().__init__(torch.where(in_corner, circle, torch.maximum(inwards, base)), box)
        self.lengths = lengths
        self.register_buffer("side", side, persistent=False)
        self.register_buffer("heights", heights, persistent=False)

    def following(self, outwards: Float[Tensor, "X Y Z"]) -> CavityGrid:
        """Return the cavity after a displacement of the outer surface; the wall keeps its thickness."""
        return CavityGrid(self.side - outwards, self.heights, self.lengths, self.box)


class _Cavity(Surface):
    """The inner surface of a vessel.

    Args:
        outer: outer surface.
        lid: triangles of the outer surface that close the opening; None for a closed vessel.
        lengths: lengths of the vessel.
        up: unit vector.
        lowest: lowest coordinate of the outer surface along `up`, world units.
    """

    def __init__(
        self,
        outer: MeshSurface,
        lid: Bool[np.ndarray, "F"] | None,
        lengths: VesselLengths,
        up: Float[np.ndarray, "3"],
        lowest: float,
    ) -> None:
        self.bounds, self._outer, self._lid = outer.bounds, outer.mesh, lid
        self._lengths, self._up, self._lowest = lengths, up, lowest

    def sampled(self, grid: Grid, box: Float[Tensor, "2 3"]) -> CavityGrid:
        lengths = self._lengths
        # The wall's inner surface and the fillet are made of these distances, and a refinement moves them.
        deep = grid.widened((2 * lengths.wall + lengths.fillet) * lengths.unit)
        side = torch.from_numpy(cached_distances(self._outer, deep, self._lid)).float()
        heights = torch.from_numpy(grid.points @ self._up - self._lowest).float()
        return CavityGrid(side, heights, lengths, box)

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return self.sampled(grid, torch.from_numpy(grid.box).float()).distances.numpy()


class _Level(Surface):
    """The half-space below the surface of a liquid."""

    def __init__(self, outer: Surface, up: Float[np.ndarray, "3"], height: float) -> None:
        self.bounds, self._up, self._height = outer.bounds, up, height

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return grid.points @ self._up - self._height


@register("medium", "sdf_vessel")
def make_vessel(
    mesh: str,
    wall: Positive,
    foot: Positive | None = None,
    level: Positive | None = None,
    closed: bool = False,
    ior: Positive = 1.5,
    liquid_ior: Positive = 1.333,
    up: list[Coordinate] = [0.0, 0.0, 1.0],  # noqa: B006 (the registry reads and copies it)
    height: Positive | None = None,
    resolution: Resolution = 128,
    box_min: Sequence[float] | None = None,
    box_max: Sequence[float] | None = None,
    shell_voxels: Positive = 0.1,
    accept_open_mesh: bool = False,
    learn_absorption: Learns = False,
    cache: bool = True,
    fillet: NotNegative = 0.0,
    glass: dict[str, Any] | None = None,
    liquid: dict[str, Any] | None = None,
    shading: Shading = "auto",
    crease_degrees: CreaseAngle | None = None,
) -> Bodies:
    """Make a drinking glass or a bottle from its outer surface and a few lengths; see `vessel`.

    Lengths are in world units. If `height` is given, they are in the same unit as `height`, for example millimetres.
    Heights are measured upwards from the lowest point.

    Args:
        mesh: outer surface of the vessel with its opening closed, as silhouettes show it: a closed triangle mesh, world
            units.
        wall: thickness of the wall.
        foot: thickness of the bottom; by default that of the wall.
        level: height of the liquid; by default the vessel is full.
        closed: whether the wall continues over the top. Otherwise the part of the outer surface at the top that faces
            up is an opening.
        ior: refractive index of the wall.
        liquid_ior: refractive index of the liquid; 1 for an empty vessel.
        up: direction from the bottom to the top, world axes; its length does not matter.
        height: outer height of the vessel, in the unit of the other lengths.
        resolution, box_min, box_max, shell_voxels, accept_open_mesh, cache, shading, crease_degrees: see
            `medium=sdf_grid`.
        learn_absorption: learn the absorption.
        fillet: radius of the rounded edge between wall and foot inside the vessel.
        glass, liquid: settings of the materials in place of `ior` and `liquid_ior`: ior or material, abbe, absorption
            and learn, as for `bodies` of `medium=sdf_grid`.
    """
    grid = GridSettings(resolution, box_min, box_max, shell_voxels, cache)
    grid.require_memory(1)
    named = {name: values for name, values in (("wall", glass), ("liquid", liquid)) if values is not None}
    settings = {"wall": BodySettings(ior=ior), "liquid": BodySettings(ior=liquid_ior)}
    settings |= expanded({"bodies": named}) if named else {}
    of_surfaces = [getattr(body, name) for body in settings.values() for name in ("mesh", "surface", *SHADING)]
    if any(value is not None for value in of_surfaces):
        raise NerfroError("medium.glass and medium.liquid describe materials; remove their mesh, surface and shading")
    learn = learned_quantities(False, learn_absorption)
    materials = {name: make_material(name, body, learn) for name, body in settings.items()}
    is_empty = settings["liquid"].ior == 1 and not settings["liquid"].absorption
    outer = MeshSurface(mesh, accept_open_mesh, shading, crease_degrees)
    low, high = extent(outer, direction("medium.up", up))
    unit = 1.0 if height is None else (high - low) / height
    lengths = VesselLengths(wall, wall if foot is None else foot, fillet, level, unit)
    return vessel(outer, lengths, materials["wall"], None if is_empty else materials["liquid"], up, closed, grid)
