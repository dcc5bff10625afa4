"""The part of a vessel's outer surface that closes its opening, where silhouettes show no hole."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nerfro.geometry.mesh import TriangleMesh

# Triangles count as level whose normals are within 45 degrees of up.
_LEVEL = np.cos(np.pi / 4)


def find_lid(mesh: TriangleMesh, up: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "F"]:
    """Which triangles belong to the lid: those around the highest one that face up, as far as they hang together.

    `up` is a unit vector. No triangle is chosen where the highest ones do not face up.
    """
    triangles = mesh.triangles
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    level = normals @ up > _LEVEL * np.linalg.norm(normals, axis=-1)
    if not level.any():
        return level
    start, end = mesh.faces[level][:, [0, 1, 1, 2]].reshape(-1, 2).T
    size = len(mesh.vertices)
    _, part = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (size, size)), directed=False)
    of_triangle = part[mesh.faces[:, 0]]
    height = np.where(level, triangles.mean(1) @ up, -np.inf)
    return level & (of_triangle == of_triangle[height.argmax()])
