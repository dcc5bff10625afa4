"""The surfaces of a medium as triangles."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.geometry.intersection import Triangles
from nerfro.geometry.mesh import TriangleMesh, merge_vertices
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.solid import Solid

# Vertices a side of the grid on which the distance of a body that has no mesh is asked.
_RESOLUTION = 128
# Triangles of a separate part that is left out, as a share of those of the largest.
_CRUMB = 0.02


@torch.no_grad()
def surface_of(medium: Medium, triangles: bool) -> list[TriangleMesh]:
    """The surface of each body with the normals that rays bend at, world units.

    Args:
        medium: of solid bodies.
        triangles: whether rays meet the triangles of its meshes, and not the zero levels of its signed distances.
    """
    if not isinstance(medium, Solid):
        raise NerfroError(f"{type(medium).__name__} has no surface: its index varies continuously, or it is none")
    if triangles and isinstance(medium, SdfGrid):
        return _meshes(medium.triangles())
    return [_zero_level(medium, body, values) for body, values in enumerate(_distances(medium))]


def _meshes(triangles: Triangles) -> list[TriangleMesh]:
    meshes = []
    for body in triangles.body.unique():
        chosen = triangles.body == body
        corners, normals = triangles.corners[chosen].numpy(), triangles.normals[chosen].numpy()
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        meshes.append(merge_vertices(corners.reshape(-1, 3), faces, normals))
    return meshes


def _zero_level(medium: Solid, body: int, values: Float[Tensor, "X Y Z"]) -> TriangleMesh:
    """Marching cubes, and a step of Newton's method for each vertex: the grid's own interpolation is not linear."""
    mesh = level_set(-values, medium.box.cpu(), 0.0)
    vertices = torch.from_numpy(mesh.vertices).to(medium.box)
    phi, gradient = (found[:, body] for found in medium.regions(vertices))
    vertices = vertices - phi[:, None] * gradient / gradient.square().sum(-1, keepdim=True).clamp(min=1e-6)
    normals = torch.nn.functional.normalize(medium.regions(vertices)[1][:, body], dim=-1).cpu().numpy()
    return TriangleMesh(vertices.double().cpu().numpy(), mesh.faces, normals[mesh.faces])


def _distances(medium: Solid) -> Float[Tensor, "K X Y Z"]:
    counts = medium.coefficients.shape[1:] if isinstance(medium, SdfGrid) else [_RESOLUTION] * 3
    box = medium.box.cpu()
    axes = [torch.linspace(float(low), float(high), n) for low, high, n in zip(*box, counts, strict=True)]
    slabs = [medium.regions(torch.cartesian_prod(x[None], *axes[1:]).to(medium.box))[0].cpu() for x in axes[0]]
    return torch.stack(slabs).view(*counts, -1).movedim(-1, 0)


def level_set(values: Float[Tensor, "X Y Z"], box: Float[Tensor, "2 3"], level: float) -> TriangleMesh:
    """Where values at the vertices of a grid over a box cross a level, by marching cubes; faces look to lower values.

    Raises:
        NerfroError: they cross it nowhere.
    """
    from skimage.measure import marching_cubes

    volume = values.numpy()
    if not volume.min() < level < volume.max():
        raise NerfroError(f"nothing crosses {level:g}: values lie between {volume.min():g} and {volume.max():g}")
    spacing = (box[1] - box[0]).double().numpy() / (np.array(volume.shape) - 1)
    vertices, faces, _, _ = marching_cubes(volume, level, gradient_direction="ascent")
    return TriangleMesh(vertices * spacing + box[0].double().numpy(), faces.astype(np.int64))


def without_crumbs(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh without its small separate parts: what a field invents to explain edges and reflections of glass."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(mesh.vertices)
    first, second = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    joined = coo_array((np.ones(len(first), np.int8), (first, second)), (size, size))
    _, part = connected_components(joined, directed=False)
    counts = np.bincount(part[mesh.faces[:, 0]], minlength=part.max() + 1)
    faces = mesh.faces[counts[part[mesh.faces[:, 0]]] >= _CRUMB * counts.max()]
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(mesh.vertices[used], index.reshape(-1, 3))
