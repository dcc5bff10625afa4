"""Normals of triangle meshes, smooth over vertices and split at creases."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerfro.geometry.mesh import TriangleMesh


def corner_normals(mesh: TriangleMesh) -> Float[np.ndarray, "F 3 3"]:
    """Compute the unit normal at each corner of each triangle, smooth up to creases.

    Informative normals of the mesh file (see `informative_normals`) are used if they lie within the crease angle of the
    mesh from the normal of the face. Otherwise the normal is the mean normal of the faces around the vertex whose
    normals are within the crease angle of the corner's face and that belong to the same facet. The weights are
    |e1 x e2| / (|e1|^2 |e2|^2) with the edges e1 and e2 at the vertex, which is exact for spheres. Where a large face
    meets much smaller faces, for example a flat side and a rounded edge, the weights are the areas, because the normal
    of the large face is the accurate one.

    Source:
        N. Max, "Weights for computing vertex normals from facet normals", Journal of Graphics Tools 4(2), 1999.
    """
    triangles = mesh.triangles
    forward = np.roll(triangles, -1, axis=1) - triangles
    backward = np.roll(triangles, 1, axis=1) - triangles
    crosses = np.cross(forward, backward)
    flat = unit(crosses[:, 0])
    areas = np.linalg.norm(crosses, axis=-1).ravel()
    lengths = ((forward**2).sum(-1) * (backward**2).sum(-1)).ravel()
    weights = np.divide(areas, lengths, out=np.zeros(areas.shape), where=lengths > 0)
    pairs = _smooth_pairs(mesh, flat, areas)
    contribution = (
        np.where(pairs.by_area, areas[pairs.second], weights[pairs.second])[:, None] * flat[pairs.second // 3]
    )
    sums = np.add.reduceat(contribution, np.flatnonzero(np.diff(pairs.first, prepend=-1)))
    smoothed = np.where((sums != 0).any(-1, keepdims=True), unit(sums), np.repeat(flat, 3, 0)).reshape(-1, 3, 3)
    if mesh.normals is None:
        return smoothed
    # Averages tilt where large flat triangles meet small curved ones; normals of the file are exact there.
    trusted = (mesh.normals * flat[:, None]).sum(-1, keepdims=True) >= np.cos(np.radians(mesh.crease_degrees))
    return np.where(trusted, mesh.normals, smoothed)


def attached_normals(mesh: TriangleMesh, vertices: Float[Tensor, "vertices 3"]) -> Float[Tensor, "F 3 3"]:
    """Compute the normals of `corner_normals` with gradients with respect to the vertices.

    Args:
        mesh: the mesh with the same vertices, without normals of a file.
        vertices: vertices in double precision.
    """
    triangles = vertices[torch.from_numpy(mesh.faces)]
    forward, backward = triangles.roll(-1, 1) - triangles, triangles.roll(1, 1) - triangles
    crosses = torch.linalg.cross(forward, backward)
    flat, areas = functional.normalize(crosses[:, 0], dim=-1), torch.linalg.vector_norm(crosses, dim=-1).flatten()
    weights = areas / (forward.square().sum(-1) * backward.square().sum(-1)).flatten()
    first, second, by_area = map(torch.from_numpy, _smooth_pairs(mesh, flat.detach().numpy(), areas.detach().numpy()))
    contribution = torch.where(by_area, areas[second], weights[second])[:, None] * flat[second // 3]
    sums = torch.zeros_like(triangles).flatten(0, 1).index_add(0, first, contribution)
    return functional.normalize(sums, dim=-1).unflatten(0, (-1, 3))


class _Pairs(NamedTuple):
    """Pairs of corners at one vertex, of which the normal of the face of the second contributes to the first.

    Attributes:
        first, second: numbers of the corners, 3 * face + corner; `first` is ascending, and contains each corner.
        by_area: whether the weight is the area of the face of the second corner.
    """

    first: Int[np.ndarray, " pairs"]
    second: Int[np.ndarray, " pairs"]
    by_area: Bool[np.ndarray, " pairs"]


def _smooth_pairs(mesh: TriangleMesh, flat: Float[np.ndarray, "F 3"], areas: Float[np.ndarray, " corners"]) -> _Pairs:
    """Find the faces that contribute to the normal at each corner; see `corner_normals`.

    Args:
        mesh: the mesh.
        flat: unit normal of each face.
        areas: area of the face of each corner.
    """
    cosine = np.cos(np.radians(mesh.crease_degrees))
    # All pairs of corners that share a vertex: corners are sorted by vertex, and each is paired with all of its group.
    corner_vertex = mesh.faces.reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(len(mesh.vertices) + 1))
    group_sizes = np.diff(starts)[corner_vertex]
    group_starts = np.cumsum(group_sizes) - group_sizes
    first = np.repeat(np.arange(len(corner_vertex)), group_sizes)
    within = np.arange(group_sizes.sum()) - np.repeat(group_starts, group_sizes)
    second = order[np.repeat(starts[corner_vertex], group_sizes) + within]
    smooth = (flat[first // 3] * flat[second // 3]).sum(1) >= cosine
    if mesh.facets is not None:
        facet, other = mesh.facets[first // 3], mesh.facets[second // 3]
        smooth &= (facet == other) | (facet < 0) | (other < 0)
    group_areas = np.where(smooth, areas[second], areas[first])
    # If the triangles around a vertex differ in size by more than this factor, areas are the weights.
    uneven = np.maximum.reduceat(group_areas, group_starts) > 8.0 * np.minimum.reduceat(group_areas, group_starts)
    smooth |= first == second
    return _Pairs(first[smooth], second[smooth], uneven[first[smooth]])


def axes_along(last: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return orthonormal axes in rows, of which the last one is a given unit vector."""
    across = np.cross(last, np.eye(3)[np.abs(last).argmin()])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(last, across), last])


def fibonacci_lattice(number: int) -> Float[np.ndarray, "number 3"]:
    """Return unit vectors that are spread evenly over the sphere."""
    index = np.arange(number) + 0.5
    z, azimuth = 1 - 2 * index / number, np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def unit(vectors: Float[np.ndarray, "vectors 3"]) -> Float[np.ndarray, "vectors 3"]:
    """Normalize vectors; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
