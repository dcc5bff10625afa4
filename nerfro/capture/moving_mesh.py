"""Triangles whose vertices move."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu

# Triangles that meet at more than this make a crease, if what is beyond them differs as much.
_CREASE = np.cos(np.radians(30))
# How far vertices move to the middle of their neighbours, along the surface.
_SPREADING = 0.5


class Surface(NamedTuple):
    """Where the vertices of a mesh are, and what follows from that."""

    vertices: Float[np.ndarray, "V 3"]
    edges: Int[np.ndarray, "E 2"]
    normals: Float[np.ndarray, "V 3"]
    creases: Int[np.ndarray, "C 2"]  # edges at which it is sharp
    beside: Float[np.ndarray, "C 2 3"]  # normals at both sides of these


class MovingMesh:
    """What is needed of triangles again and again while their vertices move.

    Attributes:
        faces: three vertices each.
        edges: two vertices each.
        mean: takes values at vertices to the means of their neighbours'.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"]) -> None:
        self.faces = faces
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        self.edges, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        of_edge = np.argsort(number.ravel(), kind="stable") // 3
        first = np.cumsum(count) - count
        # The same triangle twice where an edge has not two.
        self._beside = of_edge[np.stack([first, first + (count == 2)], -1)]
        self._beyond = faces[self._beside].sum(-1) - self.edges.sum(-1, keepdims=True)
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        num_vertices = int(faces.max()) + 1
        degree = np.bincount(both[:, 0], minlength=num_vertices)
        self.mean = sparse.csr_matrix((1 / degree[both[:, 0]], both.T), (num_vertices, num_vertices))

    def face_normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "F 3"]:
        """Of the triangles, twice as long as these are large."""
        a, b, c = vertices[self.faces].swapaxes(0, 1)
        return np.cross(b - a, c - a)

    def normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Mean normals of the triangles around each vertex, weighted with their areas."""
        of_faces = self.face_normals(vertices)
        sums = [np.bincount(self.faces.ravel(), np.repeat(each, 3), len(vertices)) for each in of_faces.T]
        return unit(np.stack(sums, -1))

    def surface(self, vertices: Float[np.ndarray, "V 3"]) -> Surface:
        """With its creases. A single vertex that is off makes none: beyond it the surface goes on as before."""
        normals = self.normals(vertices)
        beside, beyond = unit(self.face_normals(vertices))[self._beside], normals[self._beyond]
        sharp = (beside.prod(1).sum(1) < _CREASE) & (beyond.prod(1).sum(1) < _CREASE)
        return Surface(vertices, self.edges, normals, self.edges[sharp], beside[sharp])

    @cached_property
    def touching(self) -> sparse.coo_matrix:
        """[F, F]: one where triangles share a vertex, or are the same."""
        number = np.repeat(np.arange(len(self.faces)), 3)
        corners = sparse.csr_matrix((np.ones(len(number)), (number, self.faces.ravel())))
        return ((corners @ corners.T) > 0).astype(np.float64).tocoo()

    def edge_length(self, vertices: Float[np.ndarray, "V 3"]) -> float:
        """Root mean square."""
        ends = vertices[self.edges]
        return float(np.sqrt(((ends[:, 0] - ends[:, 1]) ** 2).sum(1).mean()))

    def spread(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Vertices moved along the surface, towards the middle of their neighbours, so that triangles become alike."""
        normals, towards = self.normals(vertices), self.mean @ vertices - vertices
        return vertices + _SPREADING * (towards - (towards * normals).sum(1, keepdims=True) * normals)


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Of length one; zero stays."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-12)


def solve_symmetric(system: sparse.csr_matrix, right: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Solve a system that is symmetric and positive definite.

    No pivoting is needed, and an ordering that keeps the factors sparse.
    """
    options = {"SymmetricMode": True}
    return splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options).solve(right)
