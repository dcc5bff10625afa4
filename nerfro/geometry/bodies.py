"""Connected closed surfaces of one mesh, and the check for crossing surfaces."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.geometry.intersection import MeshIntersector
from nerfro.geometry.mesh import TriangleMesh

_MARGIN = 1e-3  # fraction of an edge; surfaces that touch at the ends of an edge do not cross
_TOUCHING = 1e-5  # fraction of the mesh's extent; points closer to a surface along a line lie on the surface


def bodies_of(mesh: TriangleMesh) -> Int[np.ndarray, "F"]:
    """Return the number of the connected surface of each triangle."""
    start, end = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    size = len(mesh.vertices)
    _, body = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (size, size)), directed=False)
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
        others = _Others(np.concatenate([corners[other] for other in near.nonzero()[0]]))
        if others.are_crossed(own) or not others.leave_on_one_side(own):
            raise NerfroError(
                "closed surfaces of the mesh cross, so their inside is not defined; unite them (boolean union), "
                "or give each body inside another in bodies={NAME: {mesh: FILE, ior: 1.33}}"
            )


class _Others:
    """Closed surfaces of a mesh, for tests against another surface with triangles [F, 3, 3]."""

    def __init__(self, triangles: Float[np.ndarray, "G 3 3"]) -> None:
        self._triangles, self._intersector = torch.from_numpy(triangles), MeshIntersector(triangles)

    def are_crossed(self, own: Float[np.ndarray, "F 3 3"]) -> bool:
        """Return whether an edge crosses a triangle; the test finds crossings of any thickness."""
        start, end = (torch.from_numpy(own[:, corners].reshape(-1, 3)) for corners in ([0, 1, 2], [1, 2, 0]))
        along = end - start
        met, triangle, normal = self._first_hits(start, along)
        start, along = start[met], along[met]
        steep = (along * normal).sum(-1)
        share = ((triangle[:, 0] - start) * normal).sum(-1) / steep
        # Edges in the plane of a triangle, and edges that touch the border of a triangle, do not cross the triangle.
        through = steep.abs() > _MARGIN * along.norm(dim=-1) * normal.norm(dim=-1)
        to_corners = triangle - (start + share[:, None] * along)[:, None]
        parts = (torch.linalg.cross(to_corners, to_corners.roll(-1, 1)) * normal[:, None]).sum(-1)
        within = (parts > _MARGIN * parts.sum(-1, keepdim=True)).all(-1)
        return bool((through & within & (share > _MARGIN) & (share < 1 - _MARGIN)).any())

    def leave_on_one_side(self, own: Float[np.ndarray, "F 3 3"]) -> bool:
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
        odd = torch.stack([self._are_met_oddly(points, sign * line) for line in lines for sign in (1, -1)])
        return bool(odd.all(0).any() != (~odd).all(0).any())

    def _are_met_oddly(self, points: Float[Tensor, "points 3"], along: Float[Tensor, "3"]) -> Bool[Tensor, " points"]:
        """Return whether the line from each point crosses an odd number of triangles."""
        odd, left = torch.zeros(len(points), dtype=torch.bool), torch.arange(len(points))
        origin = points + _TOUCHING * along
        while len(left):
            met, triangle, normal = self._first_hits(origin, along.expand(len(origin), 3))
            left, origin = left[met], origin[met]
            odd[left] ^= True
            distance = ((triangle[:, 0] - origin) * normal).sum(-1) / (along * normal).sum(-1)
            origin = origin + (distance.clamp(min=0) + _TOUCHING)[:, None] * along
        return odd

    def _first_hits(
        self, start: Float[Tensor, "R 3"], along: Float[Tensor, "R 3"]
    ) -> tuple[Bool[Tensor, "R"], Float[Tensor, "M 3 3"], Float[Tensor, "M 3"]]:
        """Return a mask of the rays with a hit, and the first triangle of each of these rays with a normal."""
        hit = self._intersector.first_hits(start, along.contiguous())
        triangle = self._triangles[hit[hit >= 0]]
        return hit >= 0, triangle, torch.linalg.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
