"""Warning of walls that are too thin for a grid of signed distances."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.errors import NerfroError, warn
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.orientation import area_vectors
from nerfro.media.base import Medium
from nerfro.samplers.base import PathSampler

# Thickness, in voxels, below which the spline of one side of a wall contains the fold of the distances in its middle.
# Median error of exit directions behind a hollow ball of index 1.5: 0.01 degrees at 4.8 voxels, 0.6 at 3, and 2 at 1.8.
_MIN_VOXELS = 5.0
# Share of the surface that may belong to thinner parts, such as the surroundings of a sharp edge.
_FEW = 0.2
_NUM_POINTS = 4096
_MAX_VERTICES = 512  # largest resolution that the warning recommends


def warn_of_thin_walls(sampler: PathSampler, medium: Medium) -> None:
    """Print a warning for each body with walls that are too thin for its grid, unless the sampler traces triangles."""
    bodies = medium.bodies
    if sampler.traces_triangles or not sampler.needs_medium or bodies is None:
        return
    for name, mesh, grid in zip(bodies.names, bodies.meshes, bodies.grids, strict=False):
        if not mesh.is_closed:
            continue
        try:
            voxels = thickness(mesh) / float(grid.spacing.max())
        except NerfroError:  # without Embree
            return
        thin = voxels < _MIN_VOXELS
        if thin.mean() <= _FEW:
            continue
        factor = _MIN_VOXELS / float(np.quantile(voxels, _FEW))
        resolution = math.ceil((len(grid.distances) - 1) * factor) + 1
        finer = f"raise the resolution of the grid to {resolution}, " if resolution <= _MAX_VERTICES else ""
        warn(
            f"{thin.mean():.0%} of the surface of {name} bounds walls of about {np.median(voxels[thin]):.1f} voxels, "
            f"which bend rays in wrong directions below {_MIN_VOXELS:.0f} voxels; {finer}trace triangles "
            "(sampler/path=snell with interface=mesh), or describe a cavity as a body of index 1"
        )


def thickness(mesh: TriangleMesh) -> Float[np.ndarray, " points"]:
    """Return the distance to the opposite side at random points of a closed surface, world units."""
    triangles, normals = mesh.triangles, area_vectors(mesh.triangles)
    size = np.linalg.norm(normals, axis=1)
    generator = np.random.default_rng(0)
    face = generator.choice(len(size), _NUM_POINTS, p=size / size.sum())
    weights = generator.dirichlet(np.ones(3), _NUM_POINTS)
    inwards = torch.from_numpy(-normals[face] / size[face, None])
    below = 1e-5 * np.ptp(mesh.bounds, 0).max() * inwards
    start = torch.from_numpy((weights[..., None] * triangles[face]).sum(1)) + below
    intersector = MeshIntersector(triangles)
    hit = intersector.first_hits(start, inwards)
    return intersector.distance(start[hit >= 0], inwards[hit >= 0], hit[hit >= 0]).numpy()
