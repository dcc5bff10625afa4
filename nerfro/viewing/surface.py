"""Triangulation of the surfaces of a medium and of level sets on grids."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import corner_normals
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.solid import Solid

_ANALYTIC_RESOLUTION = 128  # vertices per side of the grid on which distances in closed form are sampled


@torch.no_grad()
def surface_of(medium: Medium, triangles: bool) -> list[TriangleMesh]:
    """Triangulate the surface of each body, with the normals at which rays bend; world units.

    Args:
        medium: medium of solid bodies.
        triangles: whether rays intersect the triangles of the medium instead of the zero levels of its distances.
    """
    if not isinstance(medium, Solid):
        raise NerfroError(
            f"{type(medium).__name__} has no surface, because its index varies continuously or is 1; "
            "train with medium=sdf_grid"
        )
    if triangles and isinstance(medium, SdfGrid):
        return [TriangleMesh(mesh.vertices, mesh.faces, corner_normals(mesh)) for mesh in medium.meshes]
    return [_zero_level(medium, body, values) for body, values in enumerate(distances_on_grid(medium))]


def _zero_level(medium: Solid, body: int, values: Float[Tensor, "X Y Z"]) -> TriangleMesh:
    """Triangulate with marching cubes, then improve each vertex by a Newton step on the distance of the medium.

    The step is needed because marching cubes interpolates linearly, and the medium does not.
    """
    mesh = level_set(-values, medium.box.cpu(), 0.0)
    vertices = torch.from_numpy(mesh.vertices).to(medium.box)
    phi, gradient = (value[:, body] for value in medium.regions(vertices))
    vertices = vertices - phi[:, None] * gradient / gradient.square().sum(-1, keepdim=True).clamp(min=1e-6)
    normals = torch.nn.functional.normalize(medium.regions(vertices)[1][:, body], dim=-1).cpu().numpy()
    return TriangleMesh(vertices.double().cpu().numpy(), mesh.faces, normals[mesh.faces])


@torch.no_grad()
def distances_on_grid(medium: Solid) -> Float[Tensor, "K X Y Z"]:
    """Sample `Solid.regions` at the vertices of a grid over the box of the medium, on the CPU."""
    counts = medium.coefficients.shape[1:] if isinstance(medium, SdfGrid) else [_ANALYTIC_RESOLUTION] * 3
    box = medium.box.cpu()
    axes = [torch.linspace(float(low), float(high), n) for low, high, n in zip(*box, counts, strict=True)]
    slabs = [medium.regions(torch.cartesian_prod(x[None], *axes[1:]).to(medium.box))[0].cpu() for x in axes[0]]
    return torch.stack(slabs).view(*counts, -1).movedim(-1, 0).contiguous()


def level_set(values: Float[Tensor, "X Y Z"], box: Float[Tensor, "2 3"], level: float) -> TriangleMesh:
    """Extract a level set of values at the vertices of a grid over a box; faces point towards lower values.

    Raises:
        NerfroError: the level is outside the range of the values.
    """
    from skimage.measure import marching_cubes

    volume = values.numpy()
    if not volume.min() < level < volume.max():
        raise NerfroError(
            f"the level {level:g} is outside the range of the values, {volume.min():g} to {volume.max():g}; "
            "choose a level inside"
        )
    spacing = (box[1] - box[0]).double().numpy() / (np.array(volume.shape) - 1)
    vertices, faces, _, _ = marching_cubes(volume, level, gradient_direction="ascent")
    return TriangleMesh(vertices * spacing + box[0].double().numpy(), faces.astype(np.int64))
