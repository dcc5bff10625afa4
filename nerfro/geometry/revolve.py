"""Meshes of bodies of revolution."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import axes_along


def revolve(
    profile: Float[np.ndarray, "points 2"], foot: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> TriangleMesh:
    """Return the closed mesh of a body of revolution.

    Args:
        profile: radii and heights along the outline, which runs counter-clockwise from axis to axis or is closed.
        foot: world coordinates of height 0 on the axis.
        axis: unit direction of the axis.
    """
    import trimesh  # takes half a second

    size = np.ptp(profile, axis=0).max()  # trimesh drops triangles with areas below 1e-8
    body = trimesh.creation.revolve(profile / size, sections=160)
    return TriangleMesh(size * body.vertices @ axes_along(axis) + foot, np.asarray(body.faces))
