"""Surfaces of bodies: signed distances at the vertices of a grid."""

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
from nerfro.geometry.bodies import require_separate, require_simple
from nerfro.geometry.facets import facets_of
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.geometry.signed_distance import signed_distance_grid
from nerfro.media.distance_grid import BAND, DistanceGrid
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
