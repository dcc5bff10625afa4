"""The part of a vessel's outer surface that closes its opening, where silhouettes show no hole."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nerfro.geometry.bodies import bodies_of
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
    part = bodies_of(TriangleMesh(mesh.vertices, mesh.faces[level]))
    highest = (triangles[level].mean(1) @ up).argmax()
    lid = np.zeros_like(level)
    lid[level] = part == part[highest]
    return lid
