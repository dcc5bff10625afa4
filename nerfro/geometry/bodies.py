"""The separate closed surfaces of one mesh: a point inside two of them that cross would count as outside."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nerfro.errors import NerfroError
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh

_MARGIN = 1e-3  # of an edge: surfaces that touch at its ends, or along it, do not cross


def bodies_of(mesh: TriangleMesh) -> Int[np.ndarray, "F"]:
    """Number of the connected surface that each triangle belongs to."""
    start, end = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    size = len(mesh.vertices)
    _, body = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (size, size)), directed=False)
    return np.unique(body[mesh.faces[:, 0]], return_inverse=True)[1].reshape(-1)


def require_separate(mesh: TriangleMesh) -> None:
    """Refuse a mesh in which an edge of one closed surface goes through another; one may lie inside another."""
    body = bodies_of(mesh)
    corners = [mesh.triangles[body == number] for number in range(body.max() + 1)]
    low, high = (np.stack([end(c.reshape(-1, 3), axis=0) for c in corners]) for end in (np.min, np.max))
    for number, own in enumerate(corners):
        near = (low <= high[number]).all(1) & (high >= low[number]).all(1)
        near[number] = False
        if near.any() and _crosses(own, np.concatenate([corners[other] for other in near.nonzero()[0]])):
            raise NerfroError(
                "closed surfaces of the mesh go through each other, and where they do there is no inside; unite them "
                "(boolean union), or give bodies inside others as medium.inner_meshes"
            )


def _crosses(own: np.ndarray, others: np.ndarray) -> bool:
    """Whether an edge of some triangles [F, 3, 3] goes through one of others [G, 3, 3]."""
    start, end = (torch.from_numpy(own[:, corners].reshape(-1, 3)) for corners in ([0, 1, 2], [1, 2, 0]))
    along = end - start
    hit = MeshIntersector(others).first_hits(start, along)
    start, along, triangle = start[hit >= 0], along[hit >= 0], torch.from_numpy(others)[hit[hit >= 0]]
    normal = torch.linalg.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    steep = (along * normal).sum(-1)
    share = ((triangle[:, 0] - start) * normal).sum(-1) / steep
    # An edge that lies in a triangle's plane does not go through it, nor does one that touches its border.
    through = steep.abs() > _MARGIN * along.norm(dim=-1) * normal.norm(dim=-1)
    to_corners = triangle - (start + share[:, None] * along)[:, None]
    parts = (torch.linalg.cross(to_corners, to_corners.roll(-1, 1)) * normal[:, None]).sum(-1)
    within = (parts > _MARGIN * parts.sum(-1, keepdim=True)).all(-1)
    return bool((through & within & (share > _MARGIN) & (share < 1 - _MARGIN)).any())
