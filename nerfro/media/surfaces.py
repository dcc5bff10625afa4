"""Surfaces of bodies: signed distances at the vertices of a grid.

Shapes are meshes, balls, boxes, bodies of revolution, distances in files, and offsets of other surfaces.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Gt, Le
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import resolve_path
from nerfro.files.cache import cached_arrays, content_hash
from nerfro.files.reading import load_arrays
from nerfro.geometry.bodies import require_separate, require_simple
from nerfro.geometry.facets import facets_of
from nerfro.geometry.mesh import TriangleMesh, load_mesh, merge_vertices
from nerfro.geometry.normals import axes_along
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.media.distance_grid import BAND, DistanceGrid
from nerfro.registry.allowed import Coordinate, NotNegative, Positive
from nerfro.registry.registration import create, discover, find, register

Shading = Literal["auto", "smooth", "flat"]
CreaseAngle = Annotated[float, Gt(0), Le(180)]
# Part of the cache key. Increase it when the same mesh and settings give different distances.
_VERSION = 4


@dataclass(frozen=True)
class Grid:
    """Vertices at which a surface is sampled.

    Attributes:
        box: lower and upper corner, world units.
        resolution: vertices along each side.
        band: distance from the surface, in voxels, up to which signed distances have to be exact.
        cache: whether results of long computations are kept in the cache folder.
    """

    box: Float[np.ndarray, "2 3"]
    resolution: int
    band: float = BAND
    cache: bool = True

    @property
    def points(self) -> Float[np.ndarray, "X Y Z 3"]:
        """Positions of the vertices, world units."""
        axes = (np.linspace(low, high, self.resolution) for low, high in self.box.T)
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1)

    def widened(self, length: float) -> Grid:
        """Return the same vertices with exact distances up to `length` world units farther from the surface."""
        voxels = length / float(np.ptp(self.box, 0).min()) * (self.resolution - 1)
        return replace(self, band=min(self.band + voxels, self.resolution))


class Surface(ABC):
    """Closed surface of a body. Subclasses set `bounds` and implement `distances`.

    Attributes:
        bounds: lower and upper corner of a box around the surface, world units.
        known: lower and upper corner of the box in which the distances are exact; None for all of space.
        mesh: triangles of the surface, which `sampler.path.interface=mesh` intersects; None if there are none.
    """

    bounds: Float[np.ndarray, "2 3"]
    known: Float[np.ndarray, "2 3"] | None = None
    mesh: TriangleMesh | None = None

    @abstractmethod
    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        """Return the signed distance to the surface at the vertices of a grid, negative inside, world units.

        Farther from the surface than `grid.band` voxels, the value may be closer to zero, down to this distance.
        """

    def sampled(self, grid: Grid, box: Float[Tensor, "2 3"]) -> DistanceGrid:
        """Sample the distances at the vertices of a grid.

        Args:
            grid: the vertices.
            box: corners of the grid, relative to the origin of the medium.
        """
        return DistanceGrid(torch.from_numpy(self.distances(grid)).float(), box)


def make_surface(settings: Mapping[str, Any], accept_open_mesh: bool = False) -> Surface:
    """Make a surface from its registered name and its settings, such as `{name: ball, radius: 0.5}`.

    Args:
        settings: `name`, and the arguments of the constructor.
        accept_open_mesh: accept a mesh with holes.
    """
    others = dict(settings)
    name = str(others.pop("name", ""))
    if name != "mesh":
        discover()  # the other surfaces are plugins
    elif accept_open_mesh:
        others["accept_open_mesh"] = True
    return create(find("surface", name), others)


@register("surface", "mesh")
class MeshSurface(Surface):
    """A closed triangle mesh.

    Args:
        file: mesh in world units, any format trimesh reads.
        accept_open_mesh: accept a mesh with holes. Rays along three axes decide by majority whether a point is inside.
        shading: whether the triangles are samples of a `smooth` surface or `flat`; `auto` decides for each face.
        crease_degrees: edges with larger angles between their triangles are sharp. If it is given, `auto` looks for no
            facets; by default 30.
    """

    mesh: TriangleMesh

    def __init__(
        self,
        file: str,
        accept_open_mesh: bool = False,
        shading: Shading = "auto",
        crease_degrees: CreaseAngle | None = None,
    ) -> None:
        mesh = load_mesh(resolve_path(file), accept_open_mesh)
        self._set(_shaded(mesh, file, shading, crease_degrees))

    @classmethod
    def of(cls, mesh: TriangleMesh, shading: Shading = "auto") -> MeshSurface:
        """Make the surface of a mesh in memory; see the class for `shading`."""
        surface = MeshSurface.__new__(MeshSurface)
        surface._set(_shaded(mesh, "the mesh", shading, None))
        return surface

    def _set(self, mesh: TriangleMesh) -> None:
        self.mesh, self.bounds = mesh, mesh.bounds
        if mesh.is_closed:
            require_separate(mesh)
            require_simple(mesh)

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return cached_distances(self.mesh, grid)


def _shaded(mesh: TriangleMesh, file: str, shading: Shading, crease_degrees: float | None) -> TriangleMesh:
    """Mark the facets of a mesh; see `MeshSurface`."""
    if shading == "flat":
        if crease_degrees is not None:
            raise NerfroError(
                f"crease_degrees={crease_degrees:g} contradicts shading=flat of {file}, with which all edges are "
                "sharp; remove one of them"
            )
        return replace(mesh, normals=None, facets=np.arange(len(mesh.faces)))
    if crease_degrees is not None:
        return replace(mesh, crease_degrees=crease_degrees)
    if shading == "smooth":
        return mesh
    number, doubt = facets_of(mesh.vertices, mesh.faces)
    if mesh.normals is not None:
        number = np.where(mesh.normals.any((1, 2)), -1, number)
    elif doubt:
        _warn_once(f"{file}: {doubt}; set shading=smooth or shading=flat of the body (bodies.NAME.shading)")
    return replace(mesh, facets=number) if (number >= 0).any() else mesh


_warn_once = cache(warn)  # several stages of a command read the same mesh


def cached_distances(
    mesh: TriangleMesh, grid: Grid, lid: Bool[np.ndarray, "F"] | None = None
) -> Float[np.ndarray, "X Y Z"]:
    """Compute the signed distances to a mesh (`signed_distance_grid`), or load them from the cache folder."""
    normals = "none" if mesh.normals is None else mesh.normals
    facets = "none" if mesh.facets is None else mesh.facets
    settings = grid.box, grid.resolution, grid.band
    left_out = () if lid is None else (lid,)
    key = "distance_" + content_hash(
        _VERSION, mesh.vertices, mesh.faces, normals, facets, mesh.crease_degrees, *settings, *left_out
    )
    arrays = cached_arrays(key, lambda: {"distance": signed_distance_grid(mesh, *settings, *left_out)}, grid.cache)
    return arrays["distance"]


def direction(name: str, values: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Return the unit vector along a direction."""
    length = np.linalg.norm(values)
    if len(values) != 3 or not length > 0:
        raise NerfroError(f"{name}={list(values)} is no direction; give three numbers, not all of them 0")
    return np.array(values, np.float64) / length


def vector(name: str, values: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Return three numbers as an array."""
    if len(values) != 3:
        raise NerfroError(f"surface.{name}={list(values)} is not allowed; give three numbers")
    return np.array(values, np.float64)


def revolve(
    profile: Float[np.ndarray, "points 2"], foot: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> TriangleMesh:
    """Return the closed mesh of a body of revolution.

    Args:
        profile: radii and heights along the outline, which runs counter-clockwise from axis to axis or is closed.
        foot: world coordinates of height 0 on the axis.
        axis: unit direction of the axis.
    """
    import trimesh  # takes half a second

    size = np.ptp(profile, axis=0).max()  # trimesh drops triangles with areas below 1e-8
    body = trimesh.creation.revolve(profile / size, sections=160)
    return TriangleMesh(size * body.vertices @ axes_along(axis) + foot, np.asarray(body.faces))


@register("surface", "ball")
class BallSurface(Surface):
    """A ball.

    Args:
        radius: world units.
        centre: world coordinates.
    """

    def __init__(self, radius: Positive, centre: Sequence[Coordinate] = (0.0, 0.0, 0.0)) -> None:
        self._radius, self._centre = radius, vector("centre", centre)
        self.bounds = np.stack([self._centre - radius, self._centre + radius])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.linalg.norm(grid.points - self._centre, axis=-1) - self._radius


@register("surface", "box")
class BoxSurface(Surface):
    """A box with sides along the axes of the world; with one short side, a pane. Sharp edges have triangles.

    Args:
        sides: lengths along x, y and z, world units.
        centre: world coordinates.
        rounding: radius of the edges, world units.
    """

    def __init__(
        self, sides: Sequence[Positive], centre: Sequence[Coordinate] = (0.0, 0.0, 0.0), rounding: NotNegative = 0.0
    ) -> None:
        self._half, self._centre, self._rounding = 0.5 * vector("sides", sides), vector("centre", centre), rounding
        if rounding > self._half.min():
            raise NerfroError(f"surface.rounding={rounding} is not allowed; give at most half of the shortest side")
        self.bounds = np.stack([self._centre - self._half, self._centre + self._half])
        if not rounding:
            import trimesh  # takes half a second

            box = trimesh.creation.box(bounds=self.bounds)
            self.mesh = TriangleMesh(np.array(box.vertices), np.array(box.faces), facets=np.arange(len(box.faces)))

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        excess = np.abs(grid.points - self._centre) - self._half + self._rounding
        return np.linalg.norm(excess.clip(min=0), axis=-1) + excess.max(-1).clip(max=0) - self._rounding


@register("surface", "revolution")
class RevolutionSurface(MeshSurface):
    """A body of revolution with a given profile, such as a cylinder, a lens or a bottle.

    Edges of the profile are smooth up to 30 degrees, so few points describe a curve.

    Args:
        profile: [radius, height] of points along the outline, from one end of the axis to the other, world units. Ends
            away from the axis get flat faces. If the last point is the first one, the outline is a ring. The outline
            must enclose a volume, and must not meet itself.
        centre: world coordinates of height 0 on the axis.
        axis: direction of the axis; its length does not matter.
    """

    def __init__(
        self,
        profile: list[Any],
        centre: Sequence[Coordinate] = (0.0, 0.0, 0.0),
        axis: Sequence[Coordinate] = (0.0, 0.0, 1.0),
    ) -> None:
        try:
            points = np.array(profile, np.float64).reshape(len(profile), 2)
        except (ValueError, TypeError):
            points = np.empty((0, 2))
        if len(points) < 2 or not np.isfinite(points).all() or points[:, 0].min() < 0:
            raise NerfroError(
                f"surface.profile={profile} is not allowed; give points [radius, height], from end to end"
            )
        is_ring = bool((points[0] == points[-1]).all())
        if not is_ring:
            points = np.concatenate([points[:1] * [0, 1], points, points[-1:] * [0, 1]])
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(1))]
        inner, outer = points[:-1, 0], points[1:, 0]
        volume = (np.diff(points[:, 1]) * (inner**2 + inner * outer + outer**2)).sum()  # with a sign, times 3 / pi
        if volume == 0 or meets_itself(points, is_ring):
            raise NerfroError(
                f"surface.profile={profile} encloses no volume, or meets itself; give an outline that begins and ends "
                "on the axis, or a ring whose last point is the first one"
            )
        if volume < 0:
            points = points[::-1]
        mesh = revolve(points, vector("centre", centre), direction("surface.axis", axis))
        self._set(merge_vertices(mesh.vertices, mesh.faces))


def meets_itself(points: Float[np.ndarray, "points 2"], is_ring: bool) -> bool:
    """Test whether two segments of an outline that are not neighbours meet."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Return on which side of the line from p to q the point r is: -1, 0 or 1."""
        (a, b), (c, d) = (q - p).T, (r - p).T
        return np.sign(a * d - b * c)

    first, second = np.triu_indices(len(points) - 1, 2)
    if is_ring:
        is_end = (first == 0) & (second == len(points) - 2)
        first, second = first[~is_end], second[~is_end]
    starts, ends = points[:-1], points[1:]
    p, q, r, s = starts[first], ends[first], starts[second], ends[second]
    near = (np.minimum(p, q) <= np.maximum(r, s)) & (np.minimum(r, s) <= np.maximum(p, q))
    crossing = (side(p, q, r) * side(p, q, s) <= 0) & (side(r, s, p) * side(r, s, q) <= 0)
    return bool((near.all(1) & crossing).any())


@register("surface", "offset")
class OffsetSurface(Surface):
    """The points at a distance from another surface, such as the inside of a wall of constant thickness.

    Args:
        surface: name and settings of the other surface.
        distance: outwards, world units; negative for inwards.
    """

    def __init__(self, surface: dict[str, Any], distance: Coordinate) -> None:
        self._other, self._distance = make_surface(surface), distance
        self.bounds = self._other.bounds + np.array([[-1], [1]]) * max(distance, 0)
        self.known = self._other.known
        if self.known is not None and ((self.bounds[0] < self.known[0]) | (self.bounds[1] > self.known[1])).any():
            raise NerfroError(
                f"surface.distance={distance} leads out of the grid of the other surface; write a larger grid, or take "
                "a smaller distance"
            )

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return self._other.distances(grid.widened(abs(self._distance))) - self._distance


@register("surface", "grid")
class GridSurface(Surface):
    """Zero level of signed distances in a file, interpolated by quadratic B-splines.

    Args:
        file: NumPy archive (.npz) with `distances` [X, Y, Z] at the vertices of a grid, negative inside and positive at
            the border, and the lower and upper corner of the grid, `box` [2, 3]; world units.
    """

    def __init__(self, file: str) -> None:
        arrays = load_arrays(resolve_path(file))
        distances, box = (np.asarray(arrays.get(name), np.float64) for name in ("distances", "box"))
        if distances.ndim != 3 or min(distances.shape) < 3 or box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise NerfroError(f"{file} is no grid of distances; write the arrays distances [X, Y, Z] and box [2, 3]")
        inside = np.argwhere(distances < 0)
        last = np.array(distances.shape) - 1
        if not len(inside) or not np.isfinite(distances).all() or inside.min() < 1 or (inside == last).any():
            raise NerfroError(f"{file}: the distances must be negative inside the body and positive at the border")
        self._grid = DistanceGrid(torch.from_numpy(distances), torch.from_numpy(box))
        spacing = (box[1] - box[0]) / last
        self.known, self.bounds = box, box[0] + spacing * np.stack([inside.min(0) - 1, inside.max(0) + 1])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.stack([self._grid(torch.from_numpy(plane))[0].numpy() for plane in grid.points])
