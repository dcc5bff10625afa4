"""Choice between the normals of a mesh file and normals that are computed from the triangles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from nerfro.geometry.orientation import area_vectors, patches

_MIN_COSINE = np.cos(np.radians(30.0))  # between the normals of a corner and of its triangle


def informative_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]
) -> Bool[np.ndarray, "F"]:
    """Find the triangles whose normals in the file say more about the surface than the triangles do.

    Programs often write averages of the normals of the adjacent triangles, or copies of the normals of the triangles.
    Averages tilt on flat faces beside rounded edges. The criterion is the residual of a smooth surface through two
    vertices: along an edge from x_i to x_j, the normals N_i and N_j of the surface satisfy

        (N_i + N_j) . (x_j - x_i) = 0

    up to terms of third order in the length of the edge, and exactly on planes, spheres, cylinders and cones. The
    normals of a patch (see `patches`) are informative if their root mean square residual is below the residuals of
    averages with common weights. Averages are taken over the corners at a vertex that have the same normal in the file,
    so that sharp edges of the file stay sharp.

    Args:
        vertices: world units; equal positions must be merged.
        faces: vertex indices of each triangle, outward faces counter-clockwise.
        normals: unit normals of the file at the corners, or zero.
    """
    triangles = vertices[faces]
    forward, backward = np.roll(triangles, -1, 1) - triangles, np.roll(triangles, 1, 1) - triangles
    areas = area_vectors(triangles)
    size = np.linalg.norm(areas, axis=1)
    flat = (areas / np.where(size > 0, size, 1.0)[:, None])[:, None]
    angle = np.arctan2(size[:, None], (forward * backward).sum(-1))
    area = np.broadcast_to(size[:, None], angle.shape)
    corner = _numbered(faces, normals)
    facet = _numbered(corner, np.broadcast_to(flat, normals.shape))
    num_coplanar = np.bincount(facet.reshape(-1))[facet]
    trusted = (normals * flat).sum(-1) >= _MIN_COSINE
    patch = np.unique(patches(faces)[0], return_inverse=True)[1]

    def residual(candidate: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, " corners"]:
        length = np.linalg.norm(forward, axis=-1)
        sums = ((candidate + np.roll(candidate, -1, 1)) * forward).sum(-1)
        cosine = np.divide(
            sums, length, out=np.zeros(length.shape), where=trusted & np.roll(trusted, -1, 1) & (length > 0)
        )
        return np.bincount(patch, (cosine**2).sum(1))

    def average(weight: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3 3"]:
        terms = (weight[..., None] * flat).reshape(-1, 3)
        sums = np.stack([np.bincount(corner.reshape(-1), column) for column in terms.T], -1)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        return (sums / np.where(length > 0, length, 1.0))[corner]

    # The second weight counts the triangles of one flat polygon once.
    weights = (np.ones(angle.shape), 1 / num_coplanar, angle, area, area * angle)
    best = np.min([residual(average(weight)) for weight in weights], axis=0)
    return (residual(normals) < 0.98**2 * best)[patch]


def _numbered(index: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]) -> Int[np.ndarray, "F 3"]:
    """Number the different pairs of an index and a rounded normal."""
    # Products with an odd number that wrap around scatter the keys evenly; sorting rows would take much longer.
    key = index.astype(np.int64)
    for axis in range(3):
        # Normals at one vertex that agree to 1e-5 are one normal.
        key = key * 6364136223846793005 + np.rint(normals[..., axis] * 1e5).astype(np.int64)
    return np.unique(key, return_inverse=True)[1].reshape(index.shape)
