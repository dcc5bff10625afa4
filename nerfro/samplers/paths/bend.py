"""Exit rays and paths of rays through a medium, without a scene."""

from __future__ import annotations

import functools
from pathlib import Path as FilePath
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path
from nerfro.geometry.intersection import Triangles
from nerfro.geometry.mesh import make_mesh
from nerfro.geometry.normals import attached_normals
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.material import Material
from nerfro.media.surfaces import MeshSurface, Shading
from nerfro.registry.registration import discover, find
from nerfro.samplers.paths.replay import intersect_triangles, replay
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from nerfro.samplers.paths.traced_file import leave_box, make_rays

# Margin of air around the body in voxels; the grid needs at least two.
_MARGIN = 4
# Resolution of the grid for triangles in tensors, which decides only whether rays begin inside.
_COARSE = 16


class Bent(NamedTuple):
    """Exit rays at the box around the body, in CPU memory.

    Attributes:
        positions: exit positions in world units, in the type of the origins; paths are computed in single precision.
        directions: unit exit directions.
        lengths: lengths of the paths from the origins, world units.
        hit: whether each ray met the body.
    """

    positions: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    lengths: Float[Tensor, "R"]
    hit: Bool[Tensor, "R"]


@functools.singledispatch
def bend(
    mesh: Any,
    ior: float | Tensor,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    interface: Literal["mesh", "sdf"] = "mesh",
    resolution: int = 128,
) -> Bent:
    """Trace rays through a body of constant index by Snell's law, including total reflection.

    `bend(vertices, faces, ior, origins, directions, shading="auto")` takes the triangles as tensors, traces them in
    double precision, and has gradients with respect to the vertices. In both forms, the results have gradients with
    respect to the index and the rays if these are tensors that require gradients. Silhouettes that move, and
    refractions that appear, have no gradients; see `nerfro.samplers.paths.replay`.

    Args:
        mesh: file of a closed triangle mesh in world units, in any format that trimesh reads, or an object with
            `vertices` and `faces`, such as `trimesh.Trimesh`.
        ior: refractive index of the body; the index outside is 1.
        origins, directions: rays [R, 3] in the world of the mesh; directions need not have unit length.
        interface: `mesh` traces the triangles, `sdf` a smooth surface; see `sampler/path=snell`.
        resolution: number of vertices along each side of the grid of signed distances, at least 10.

    Returns:
        Exit positions, exit directions and path lengths.

    Raises:
        NerfroError: the mesh cannot be read or is open, the rays are not [R, 3] finite numbers, or the resolution is
            less than 10.
    """
    if resolution <= 2 * _MARGIN + 1:
        raise NerfroError(f"resolution={resolution} is not allowed; give at least {2 * _MARGIN + 2}")
    starts, towards = _checked_rays(origins, directions)
    if isinstance(mesh, (str, FilePath)):
        surface = MeshSurface(str(mesh))
    else:
        surface = MeshSurface.of(make_mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)))
    medium = _medium(surface, ior, resolution)
    sampler = Snell(interface)
    warn_of_thin_walls(sampler, medium)
    rays = make_rays(starts, towards, medium, 0.0, None)
    path = sampler(rays.detach(), medium)
    if _learns(ior, origins, directions):
        path = sampler.replay(path, rays, medium.with_indices(torch.as_tensor(ior)[None]))
    return _bent(path, medium, medium.box, starts)


@bend.register(Tensor)
@bend.register(np.ndarray)
def _bend_triangles(
    vertices: ArrayLike | Tensor,
    faces: ArrayLike | Tensor,
    ior: float | Tensor,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    shading: Shading = "auto",
) -> Bent:
    """Trace rays through triangles with gradients; see `bend`.

    Args:
        vertices: positions [V, 3] in world units.
        faces: indices [F, 3] of the vertices of each triangle; no two vertices have equal positions.
        ior, origins, directions: see `bend`.
        shading: whether the triangles are samples of a `smooth` surface or `flat`; `auto` decides for each face, so the
            decision may change while vertices are optimized.
    """
    starts, towards = (values.cpu().double() for values in _checked_rays(origins, directions))
    corners, triangles = torch.as_tensor(vertices).cpu().double(), torch.as_tensor(faces).cpu().numpy().astype(np.int64)
    checked = make_mesh(corners.detach().numpy(), triangles)
    if len(checked.vertices) != len(corners) or len(checked.faces) != len(triangles):
        raise NerfroError("the mesh repeats vertices or triangles; merge them before tracing")
    # `make_mesh` sorts the vertices.
    order = torch.from_numpy(np.unique(corners.detach().numpy(), axis=0, return_index=True)[1])
    surface = MeshSurface.of(checked, shading)
    medium = _medium(surface, ior, _COARSE)
    sampler, origin = Snell("mesh"), torch.from_numpy(medium.origin)
    rays = make_rays(starts, towards, medium, 0.0, None, torch.float64)
    path, corners = sampler(rays.detach(), medium), corners[order] - origin
    if _learns(vertices, ior, origins, directions):
        attached = Triangles(
            corners[torch.from_numpy(checked.faces)],
            attached_normals(surface.mesh.relative_to(medium.origin), corners),
            medium.triangles.body,
        )
        assert path.record is not None
        indexed = medium.with_indices(torch.as_tensor(ior)[None])
        path = replay(path, rays, indexed, intersect_triangles(attached, path.record.triangle))
    # In double precision, and moved by the vertices.
    box = torch.stack(_box_around(corners.amin(0), corners.amax(0), _COARSE))
    return _bent(path, medium, box, starts)


def _box_around(low: Any, high: Any, resolution: int) -> tuple[Any, Any]:
    """Add the margin of air to the bounds of a body."""
    margin = (high - low).max() * _MARGIN / (resolution - 1 - 2 * _MARGIN)
    return low - margin, high + margin


def _medium(surface: MeshSurface, ior: float | Tensor, resolution: int) -> Bodies:
    low, high = _box_around(surface.bounds[0], surface.bounds[1], resolution)
    grid = GridSettings(resolution, low.tolist(), high.tolist(), cache=resolution != _COARSE)
    return Bodies([Body("object", surface, Material(float(torch.as_tensor(ior).detach())))], grid=grid)


def _learns(*values: object) -> bool:
    return any(isinstance(value, Tensor) and value.requires_grad for value in values)


def _bent(path: Path, medium: Bodies, box: Float[Tensor, "2 3"], starts: Float[Tensor, "R 3"]) -> Bent:
    positions, lengths = leave_box(path, box)
    return Bent((positions + torch.from_numpy(medium.origin)).to(starts), path.exit_directions, lengths, path.refracted)


def polylines(
    medium: Medium,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    length: float | None = None,
    interface: Literal["mesh", "sdf"] = "sdf",
) -> list[np.ndarray]:
    """Trace rays through a medium, and return the vertices of the paths, for example for a plot.

    Args:
        medium: bodies, traced by Snell's law, or a medium with a continuous index, traced by the ray equation.
        origins, directions: rays [R, 3], world units; directions need not have unit length.
        length: length of the paths, world units; bent paths end outside of the medium. By default, paths end well
            beyond the medium.
        interface: `mesh` traces the triangles of bodies, `sdf` smooth surfaces; see `sampler/path=snell`.

    Returns:
        One array of vertices [S, 3] for each ray.

    Raises:
        NerfroError: the rays are not [R, 3] finite numbers.
    """
    rays = make_rays(*_checked_rays(origins, directions), medium, 0.0, length)
    if medium.bodies is not None:
        path = Snell(interface)(rays, medium)
    else:
        discover()  # the sampler is a plugin
        path = find("sampler/path", "eikonal").cls()(rays, medium)
    vertices = zip(path.positions.numpy() + medium.origin, path.s.numpy(), strict=True)
    # All rows have the same length and repeat the last vertex.
    return [positions[np.diff(s, prepend=-1.0) > 0] for positions, s in vertices]


def _checked_rays(
    origins: ArrayLike | Tensor, directions: ArrayLike | Tensor
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Convert rays to tensors with unit directions."""
    starts, towards = (
        values if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values))
        for values in (origins, directions)
    )
    starts, towards = (values if values.is_floating_point() else values.double() for values in (starts, towards))
    if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.shape != towards.shape or not len(starts):
        raise NerfroError(f"origins {list(starts.shape)} and directions {list(towards.shape)} must both be [R, 3]")
    lengths = torch.linalg.vector_norm(towards, dim=-1)
    if not (torch.isfinite(starts).all() and torch.isfinite(lengths).all() and (lengths > 0).all()):
        raise NerfroError("origins and directions must be finite numbers, and no direction zero; correct them")
    return starts, functional.normalize(towards, dim=-1)
