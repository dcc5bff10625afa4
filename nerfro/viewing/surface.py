"""Triangulation of the surfaces of a medium and of level sets on grids."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import corner_normals
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies


@torch.no_grad()
def surface_of(medium: Medium, triangles: bool) -> list[TriangleMesh]:
    """Triangulate the surface of each body, with the normals at which rays bend; world units.

    Args:
        medium: medium of bodies.
        triangles: whether rays intersect the triangles of the medium instead of the zero levels of its distances.
    """
    bodies = medium.bodies
    if bodies is None:
        raise NerfroError(
            f"{type(medium).__name__} has no surface, because its index varies continuously or is 1; "
            "train with medium=sdf_grid"
        )
    if triangles:
        return [TriangleMesh(mesh.vertices, mesh.faces, corner_normals(mesh)) for mesh in bodies.meshes]
    return [_zero_level(bodies, number) for number in range(len(bodies.names))]


def _zero_level(medium: Bodies, body: int) -> TriangleMesh:
    """Triangulate with marching cubes, then improve each vertex by a Newton step on the distance of the medium.

    The step is needed because marching cubes interpolates linearly, and the medium does not.
    """
    values, box = _region_on_grid(medium, body)
    mesh = level_set(-values, box, 0.0)
    vertices = torch.from_numpy(mesh.vertices).to(medium.box)
    phi, gradient = (value[:, body] for value in medium.regions(vertices))
    vertices = vertices - phi[:, None] * gradient / gradient.square().sum(-1, keepdim=True).clamp(min=1e-6)
    normals = torch.nn.functional.normalize(medium.regions(vertices)[1][:, body], dim=-1).cpu().numpy()
    return TriangleMesh(vertices.double().cpu().numpy(), mesh.faces, normals[mesh.faces])


def _region_on_grid(medium: Bodies, body: int) -> tuple[Float[Tensor, "X Y Z"], Float[Tensor, "2 3"]]:
    """Sample `Bodies.regions` of a body at the vertices of its grid, on the CPU; returns also the corners."""
    grid = medium.grids[body]
    box = grid.box.cpu()
    counts = grid.distances.shape
    axes = [torch.linspace(float(low), float(high), n) for low, high, n in zip(*box, counts, strict=True)]
    slabs = [torch.cartesian_prod(x[None], *axes[1:]).to(medium.box) for x in axes[0]]
    return torch.stack([medium.regions(slab)[0][..., body].cpu() for slab in slabs]).view(*counts), box


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
