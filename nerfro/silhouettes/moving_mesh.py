"""Triangle meshes with fixed connectivity and moving vertices."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from nerfro.geometry.normals import unit
from nerfro.geometry.orientation import area_vectors

# Cosine of the smallest angle between the triangles at a crease, and between the normals on both sides beyond them.
_CREASE = np.cos(np.radians(30))


class MeshGeometry(NamedTuple):
    """Vertices of a mesh with derived normals and creases."""

    vertices: Float[np.ndarray, "vertices 3"]
    edges: Int[np.ndarray, "edges 2"]
    normals: Float[np.ndarray, "vertices 3"]
    creases: Int[np.ndarray, "creases 2"]  # sharp edges
    beside: Float[np.ndarray, "creases 2 3"]  # normals on both sides of the sharp edges


class MovingMesh:
    """Connectivity of a triangle mesh.

    Attributes:
        faces: vertex indices of the triangles.
        edges: vertex indices of the edges.
        degree: number of edges at each vertex.
        mean: sparse matrix that maps values at vertices to the mean over their neighbours.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"]) -> None:
        self.faces = faces
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        self.edges, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        of_edge = np.argsort(number.ravel(), kind="stable") // 3
        first = np.cumsum(count) - count
        # A border edge repeats its only triangle.
        self._beside = of_edge[np.stack([first, first + (count == 2)], -1)]
        self._beyond = faces[self._beside].sum(-1) - self.edges.sum(-1, keepdims=True)
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        num_vertices = int(faces.max()) + 1
        self.degree = np.bincount(both[:, 0], minlength=num_vertices)
        self.mean = scipy.sparse.csr_matrix((1 / self.degree[both[:, 0]], both.T), (num_vertices, num_vertices))

    def face_normals(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "F 3"]:
        """Compute triangle normals whose length is twice the area."""
        return area_vectors(vertices[self.faces])

    def normals(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Compute unit vertex normals as area-weighted means over the adjacent triangles."""
        of_faces = self.face_normals(vertices)
        sums = [np.bincount(self.faces.ravel(), np.repeat(values, 3), len(vertices)) for values in of_faces.T]
        return unit(np.stack(sums, -1))

    def geometry(self, vertices: Float[np.ndarray, "vertices 3"]) -> MeshGeometry:
        """Compute normals and creases. A single displaced vertex is no crease, because the normals around it agree."""
        normals = self.normals(vertices)
        beside, beyond = unit(self.face_normals(vertices))[self._beside], normals[self._beyond]
        sharp = (beside.prod(1).sum(1) < _CREASE) & (beyond.prod(1).sum(1) < _CREASE)
        return MeshGeometry(vertices, self.edges, normals, self.edges[sharp], beside[sharp])

    @cached_property
    def touching(self) -> scipy.sparse.coo_matrix:
        """Adjacency matrix [F, F]: one for triangles that share a vertex, and on the diagonal."""
        number = np.repeat(np.arange(len(self.faces)), 3)
        corners = scipy.sparse.csr_matrix((np.ones(len(number)), (number, self.faces.ravel())))
        return ((corners @ corners.T) > 0).astype(np.float64).tocoo()

    def edge_length(self, vertices: Float[np.ndarray, "vertices 3"]) -> float:
        """Return the root mean square edge length."""
        ends = vertices[self.edges]
        return float(np.sqrt(((ends[:, 0] - ends[:, 1]) ** 2).sum(1).mean()))

    def spread(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Move vertices tangentially by half the way to the centroid of their neighbours, to equalize the triangles."""
        normals, towards = self.normals(vertices), self.mean @ vertices - vertices
        return vertices + 0.5 * (towards - (towards * normals).sum(1, keepdims=True) * normals)


def solve_symmetric(
    system: scipy.sparse.spmatrix, right: Float[np.ndarray, " vectors"]
) -> Float[np.ndarray, " vectors"]:
    """Solve a sparse symmetric positive definite system, without pivoting and with a fill-reducing ordering."""
    options = {"SymmetricMode": True}
    return scipy.sparse.linalg.splu(
        system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options
    ).solve(right)
