"""Connected closed surfaces of one mesh, and the check for crossing surfaces."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh

_MARGIN = 1e-3  # fraction of an edge; surfaces that touch at the ends of an edge do not cross
_TOUCHING = 1e-5  # fraction of the mesh's extent; points closer to a surface along a line lie on the surface


def bodies_of(mesh: TriangleMesh) -> Int[np.ndarray, "F"]:
    """Return the number of the connected surface of each triangle."""
    from trimesh.graph import connected_component_labels

    body = connected_component_labels(mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices))
    return np.unique(body[mesh.faces[:, 0]], return_inverse=True)[1].reshape(-1)


def require_separate(mesh: TriangleMesh) -> None:
    """Raise an error if closed surfaces of a mesh cross or coincide; nested surfaces are allowed.

    A point inside two crossing surfaces would count as outside, because inside and outside are decided by parity.
    """
    body = bodies_of(mesh)
    # Scaled to extent one around the origin, because Embree computes in single precision.
    triangles = (mesh.triangles - mesh.bounds.mean(0)) / np.ptp(mesh.bounds, axis=0).max()
    corners = [triangles[body == number] for number in range(body.max() + 1)]
    low, high = (np.stack([end(c.reshape(-1, 3), axis=0) for c in corners]) for end in (np.min, np.max))
    for number, own in enumerate(corners):
        near = (low <= high[number] + _TOUCHING).all(1) & (high >= low[number] - _TOUCHING).all(1)
        near[number] = False
        if not near.any():
            continue
        others = MeshIntersector(np.concatenate([corners[other] for other in near.nonzero()[0]]))
        if _are_crossed(others, own) or not _is_on_one_side(others, own):
            raise NerfroError(
                "closed surfaces of the mesh cross, so their inside is not defined; unite them (boolean union), "
                "or give each body inside another in bodies={NAME: {mesh: FILE, ior: 1.33}}"
            )


def _are_crossed(others: MeshIntersector, own: Float[np.ndarray, "F 3 3"]) -> bool:
    """Return whether an edge of a surface crosses a triangle; the test finds crossings of any thickness."""
    start, end = (torch.from_numpy(own[:, corners].reshape(-1, 3)) for corners in ([0, 1, 2], [1, 2, 0]))
    along = end - start
    hit = others.first_hits(start, along)
    start, along, hit = start[hit >= 0], along[hit >= 0], hit[hit >= 0]
    normal, share = others.areas(hit), others.distance(start, along, hit)
    # Edges in the plane of a triangle, and edges that touch the border of a triangle, do not cross the triangle.
    through = (along * normal).sum(-1).abs() > _MARGIN * along.norm(dim=-1) * normal.norm(dim=-1)
    to_corners = others.corners[hit] - (start + share[:, None] * along)[:, None]
    parts = (torch.linalg.cross(to_corners, to_corners.roll(-1, 1)) * normal[:, None]).sum(-1)
    within = (parts > _MARGIN * parts.sum(-1, keepdim=True)).all(-1)
    return bool((through & within & (share > _MARGIN) & (share < 1 - _MARGIN)).any())


def _is_on_one_side(others: MeshIntersector, own: Float[np.ndarray, "F 3 3"]) -> bool:
    """Return whether all points of a surface lie inside, or all outside; finds crossings where only edges meet.

    A surface without points clear of the others coincides with the others and has no side.
    """
    generator = np.random.default_rng(0)
    # Between 512 and 65,536 points of a body are tested, on three lines through each point.
    some = own[:: -(-len(own) // 2**16)]
    weights = generator.dirichlet(np.ones(3), (-(-512 // len(some)), len(some)))
    points = torch.from_numpy(np.einsum("nfc,fcx->nfx", weights, some).reshape(-1, 3))
    lines = torch.nn.functional.normalize(torch.from_numpy(generator.normal(size=(3, 3))), dim=-1)
    # For points on a surface, the parities of the two directions differ.
    odd = torch.stack([_are_met_oddly(others, points, sign * line) for line in lines for sign in (1, -1)])
    return bool(odd.all(0).any() != (~odd).all(0).any())


def _are_met_oddly(
    others: MeshIntersector, points: Float[Tensor, "points 3"], along: Float[Tensor, "3"]
) -> Bool[Tensor, " points"]:
    """Return whether the line from each point crosses an odd number of triangles."""
    odd, left = torch.zeros(len(points), dtype=torch.bool), torch.arange(len(points))
    origin = points + _TOUCHING * along
    while len(left):
        hit = others.first_hits(origin, along.repeat(len(origin), 1))
        left, origin, hit = left[hit >= 0], origin[hit >= 0], hit[hit >= 0]
        odd[left] ^= True
        distance = others.distance(origin, along, hit)
        origin = origin + (distance.clamp(min=0) + _TOUCHING)[:, None] * along
    return odd
