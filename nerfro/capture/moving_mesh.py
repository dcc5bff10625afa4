"""Triangles whose vertices move."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

# Triangles that meet at more than this make a crease, if what is beyond them differs as much.
_CREASE = np.cos(np.radians(30))
# How far vertices move to the middle of their neighbours, along the surface.
_SPREADING = 0.5


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

    def creases(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Int[np.ndarray, "C 2"], Float[np.ndarray, "C 2 3"]]:
        """Edges at which the surface is sharp, and the normals at both sides.

        A single vertex that is off makes none: beyond it the surface goes on as before.
        """
        beside = unit(self.face_normals(vertices))[self._beside]
        beyond = self.normals(vertices)[self._beyond]
        sharp = (beside.prod(1).sum(1) < _CREASE) & (beyond.prod(1).sum(1) < _CREASE)
        return self.edges[sharp], beside[sharp]

    def spread(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Vertices moved along the surface, towards the middle of their neighbours, so that triangles become alike."""
        normals, towards = self.normals(vertices), self.mean @ vertices - vertices
        return vertices + _SPREADING * (towards - (towards * normals).sum(1, keepdims=True) * normals)


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Of length one; zero stays."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-12)
