"""Normals of triangle meshes, smooth over vertices and split at creases."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.geometry.mesh import TriangleMesh

# Ratio of the largest to the smallest triangle around a vertex above which areas are the weights.
_UNEVEN = 8.0

# Edges with larger angles between their faces stay sharp, in degrees; 30 is a common default of modelling programs.
CREASE_DEGREES = 30.0


def corner_normals(mesh: TriangleMesh, crease_degrees: float = CREASE_DEGREES) -> Float[np.ndarray, "F 3 3"]:
    """Return the unit normal at each corner of each triangle, smooth up to creases; see `smooth_normals`."""
    return smooth_normals(mesh, torch.from_numpy(mesh.triangles), crease_degrees).numpy()


def smooth_normals(
    mesh: TriangleMesh, triangles: Float[Tensor, "F 3 3"], crease_degrees: float = CREASE_DEGREES
) -> Float[Tensor, "F 3 3"]:
    """Compute the unit normal at each corner of each triangle, smooth up to creases and differentiable.

    Informative normals of the mesh file (see `informative_normals`) are used if they lie within the crease angle of
    the face. Otherwise the normal is the mean
    normal of the faces around the vertex whose normals are within the crease angle of the corner's face. The weights
    are |e1 x e2| / (|e1|^2 |e2|^2) with the edges e1 and e2 at the vertex, which is exact for spheres. Where a large
    face meets much smaller faces, for example a flat side and a rounded edge, the weights are the areas, because the
    normal of the large face is the accurate one.

    Args:
        mesh: connectivity, and normals of the file.
        triangles: current positions of the corners, world units.
        crease_degrees: largest angle between faces whose normals are averaged, degrees.

    Source:
        N. Max, "Weights for computing vertex normals from facet normals", Journal of Graphics Tools 4(2), 1999.
    """
    forward = triangles.roll(-1, 1) - triangles
    backward = triangles.roll(1, 1) - triangles
    crosses = torch.linalg.cross(forward, backward)
    normals = _unit(crosses[:, 0])
    areas = torch.linalg.vector_norm(crosses, dim=-1).reshape(-1)
    lengths = ((forward**2).sum(-1) * (backward**2).sum(-1)).reshape(-1)
    weights = torch.where(lengths > 0, areas / torch.where(lengths > 0, lengths, 1.0), 0.0)
    cosine = np.cos(np.radians(crease_degrees))
    # All pairs of corners that share a vertex: corners are sorted by vertex, and each is paired with all of its group.
    corner_vertex = mesh.faces.reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(len(mesh.vertices) + 1))
    group_sizes = np.diff(starts)[corner_vertex]
    first = np.repeat(np.arange(len(corner_vertex)), group_sizes)
    within = np.arange(group_sizes.sum()) - np.repeat(np.cumsum(group_sizes) - group_sizes, group_sizes)
    second = order[np.repeat(starts[corner_vertex], group_sizes) + within]
    # The choice of faces and weights is not differentiated.
    flat, size = normals.detach().numpy(), areas.detach().numpy()
    smooth = (flat[first // 3] * flat[second // 3]).sum(1) >= cosine
    group_areas = np.where(smooth, size[second], size[first])
    group_starts = np.cumsum(group_sizes) - group_sizes
    uneven = np.maximum.reduceat(group_areas, group_starts) > _UNEVEN * np.minimum.reduceat(group_areas, group_starts)
    weight = torch.where(torch.from_numpy(uneven[first]), areas[second], weights[second]) * torch.from_numpy(smooth)
    contribution = normals[second // 3] * weight[:, None]
    sums = torch.zeros_like(contribution[: len(corner_vertex)]).index_add(0, torch.from_numpy(first), contribution)
    smoothed = torch.where((sums != 0).any(-1, keepdim=True), _unit(sums), normals.repeat_interleave(3, 0))
    smoothed = smoothed.reshape(-1, 3, 3)
    if mesh.normals is None:
        return smoothed
    # Averages tilt where large flat triangles meet small curved ones; normals of the file are exact there.
    trusted = (mesh.normals * flat[:, None]).sum(-1, keepdims=True) >= cosine
    return torch.where(torch.from_numpy(trusted), torch.from_numpy(mesh.normals), smoothed)


def _unit(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Normalize vectors; zero vectors stay zero and have finite gradients."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1.0)
