"""The part of a vessel's outer surface that closes the opening, which silhouettes do not show."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nerfro.geometry.bodies import bodies_of
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import area_vectors


def find_lid(mesh: TriangleMesh, up: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "F"]:
    """Find the lid of a mesh: the connected level triangles around the highest level triangle.

    Triangles count as level if their normals are within 45 degrees of up.

    Args:
        mesh: outer surface of the vessel.
        up: unit vector.

    Returns:
        Whether each triangle belongs to the lid; false everywhere if no triangle is level.
    """
    triangles = mesh.triangles
    normals = area_vectors(triangles)
    level = normals @ up > np.cos(np.pi / 4) * np.linalg.norm(normals, axis=-1)
    if not level.any():
        return level
    component = bodies_of(TriangleMesh(mesh.vertices, mesh.faces[level]))
    highest = (triangles[level].mean(1) @ up).argmax()
    lid = np.zeros_like(level)
    lid[level] = component == component[highest]
    return lid
