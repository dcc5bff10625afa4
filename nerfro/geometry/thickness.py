"""Thickness of the walls of closed surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from nerfro.geometry.bodies import crossings, points_below
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh

# Thickness, in voxels, below which the spline of one side of a wall contains the fold of the distances in its middle.
# Median error of exit directions behind a hollow ball of index 1.5: 0.01 degrees at 4.8 voxels, 0.6 at 3, and 2 at 1.8.
MIN_VOXELS = 5.0
# Share of the surface that may belong to thinner parts, such as the surroundings of a sharp edge.
FEW = 0.2
_NUM_POINTS = 4096
_BESIDE = 2e-3  # distance from a wall to the content of a vessel, as a fraction of the extent of the mesh


def thickness(mesh: TriangleMesh, others: Sequence[TriangleMesh] = ()) -> Float[np.ndarray, " points"]:
    """Return the distance to the opposite side at random points of a closed surface, world units.

    Args:
        mesh: the surface.
        others: closed surfaces of other bodies. The distance is infinite where one of them is on a side of the wall,
            because light that passes the wall into a liquid depends little on the thickness.
    """
    start, inwards = points_below(mesh, _NUM_POINTS)
    intersector = MeshIntersector(mesh.triangles)
    hit = intersector.first_hits(start, inwards)
    start, inwards, hit = start[hit >= 0], inwards[hit >= 0], hit[hit >= 0]
    distance = intersector.distance(start, inwards, hit)
    centre, extent = torch.from_numpy(mesh.bounds.mean(0)), float(np.ptp(mesh.bounds, axis=0).max())
    beside = _BESIDE * extent
    sides = [start - beside * inwards, start + (distance + beside)[:, None] * inwards]
    for other in others:
        triangles = MeshIntersector((torch.from_numpy(other.triangles) - centre) / extent)
        for side in sides:
            _, winding = crossings(triangles, (side - centre) / extent, inwards)
            distance = torch.where(winding != 0, torch.inf, distance)
    return distance.numpy()
