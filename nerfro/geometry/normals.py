"""Normals of triangle meshes: smooth where the surface is smooth, split at creases."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.geometry.mesh import TriangleMesh

# Ratio of the largest to the smallest triangle around a vertex from which on the large one decides.
_UNEVEN = 8.0

# Edges with larger angles between their faces stay sharp, in degrees; 30 is a common default of modelling programs.
CREASE_DEGREES = 30.0


def corner_normals(mesh: TriangleMesh, crease_degrees: float = CREASE_DEGREES) -> Float[np.ndarray, "F 3 3"]:
    """Unit normal at each corner of each triangle, smooth over the vertex up to creases; see `smooth_normals`."""
    return smooth_normals(mesh, torch.from_numpy(mesh.triangles), crease_degrees).numpy()


def smooth_normals(
    mesh: TriangleMesh, triangles: Float[Tensor, "F 3 3"], crease_degrees: float = CREASE_DEGREES
) -> Float[Tensor, "F 3 3"]:
    """Unit normal at each corner of each triangle, smooth over the vertex up to creases, with gradients by the corners.

    The mesh's own normals are taken where it has them and they lie within the crease angle of the face. Else it is the
    mean normal of the faces around the vertex whose normals are within the crease angle of the corner's own face, with
    the weights |e1 x e2| / (|e1|^2 |e2|^2), e the edges at the vertex, which are exact for spheres. Where a large face
    meets much smaller ones, as a flat side meets its rounded edge, the weights are the areas instead: there the large
    face knows the normal.

    The mesh says which triangles meet in which vertex; `triangles` are its corners, where they are now.

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
    # All pairs of corners that meet in a vertex: corners sorted by vertex, then every corner against its whole run.
    corner_vertex = mesh.faces.reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(len(mesh.vertices) + 1))
    runs = np.diff(starts)[corner_vertex]
    first = np.repeat(np.arange(len(corner_vertex)), runs)
    within = np.arange(runs.sum()) - np.repeat(np.cumsum(runs) - runs, runs)
    second = order[np.repeat(starts[corner_vertex], runs) + within]
    # What is smooth and what is uneven is decided, not differentiated.
    flat, size = normals.detach().numpy(), areas.detach().numpy()
    smooth = (flat[first // 3] * flat[second // 3]).sum(1) >= cosine
    fan_areas = np.where(smooth, size[second], size[first])
    fans = np.cumsum(runs) - runs
    uneven = np.maximum.reduceat(fan_areas, fans) > _UNEVEN * np.minimum.reduceat(fan_areas, fans)
    weight = torch.where(torch.from_numpy(uneven[first]), areas[second], weights[second]) * torch.from_numpy(smooth)
    contribution = normals[second // 3] * weight[:, None]
    sums = torch.zeros_like(contribution[: len(corner_vertex)]).index_add(0, torch.from_numpy(first), contribution)
    smoothed = torch.where((sums != 0).any(-1, keepdim=True), _unit(sums), normals.repeat_interleave(3, 0))
    smoothed = smoothed.reshape(-1, 3, 3)
    if mesh.normals is None:
        return smoothed
    # Averages tilt where large flat triangles meet small round ones; a modeller's normals do not.
    trusted = (mesh.normals * flat[:, None]).sum(-1, keepdims=True) >= cosine
    return torch.where(torch.from_numpy(trusted), torch.from_numpy(mesh.normals), smoothed)


def _unit(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Vectors of length one; zero where there is none, with finite gradients."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1.0)
