"""Intersection of rays and triangles: by Embree for calls from Python, and the tree of triangles that kernels search.

Kernels cannot call Embree, so `TriangleTree` is a tree of bounding boxes in arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import corner_normals
from nerfro.geometry.orientation import patches


class Planes:
    """Planes of triangles in double precision.

    Attributes:
        corners: corners of each triangle, world units.
    """

    corners: Float[Tensor, "F 3 3"]

    def areas(self, face: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Return normals by the right-hand rule, with a length of twice the area of the triangle."""
        a, b, c = self.corners[face].unbind(-2)
        return torch.linalg.cross(b - a, c - a)

    def distance(
        self, x: Float[Tensor, "*#batch 3"], d: Float[Tensor, "*#batch 3"], face: Int[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch"]:
        """Return the distance to a triangle's plane along each ray."""
        normal = self.areas(face)
        return ((self.corners[face, 0] - x) * normal).sum(-1) / (d * normal).sum(-1)


@dataclass(frozen=True)
class Triangles(Planes):
    """Triangles of several bodies in double precision.

    Attributes:
        corners: corners of each triangle, world units.
        normals: unit normal at each corner, split at creases.
        body: number of the body of each triangle.
    """

    corners: Float[Tensor, "F 3 3"]
    normals: Float[Tensor, "F 3 3"]
    body: Int[Tensor, "F"]

    @classmethod
    def of(cls, meshes: list[TriangleMesh]) -> Triangles:
        """Collect the triangles of meshes, one mesh per body, with smooth normals up to the crease angle."""
        corners = np.concatenate([mesh.triangles for mesh in meshes])
        normals = np.concatenate([corner_normals(mesh) for mesh in meshes])
        body = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        return cls(*map(torch.from_numpy, (corners, normals, body)))

    def normal(self, x: Float[Tensor, "R 3"], face: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Interpolate unit normals at points of triangles with barycentric coordinates."""
        corners, normal = self.corners[face], self.areas(face)
        areas = [torch.linalg.cross(corners[:, (i + 1) % 3] - x, corners[:, (i + 2) % 3] - x) for i in range(3)]
        weights = torch.stack([(area * normal).sum(-1) for area in areas], -1)
        weights = (weights / weights.sum(-1, keepdim=True)).clamp(0, 1)
        return torch.nn.functional.normalize((weights[..., None] * self.normals[face]).sum(1), dim=-1)


class MeshIntersector(Planes):
    """First hits of rays with triangles, which are given by the corners."""

    def __init__(self, corners: Float[Tensor, "F 3 3"] | Float[np.ndarray, "F 3 3"]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh as EmbreeMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise NerfroError(
                f"intersections with triangles need Embree ({error}); pip install embreex (no wheel for Linux on ARM)"
            ) from error
        self._scene = EmbreeScene()
        # Embree computes in single precision, which is most accurate around the origin.
        self.corners = torch.as_tensor(corners, dtype=torch.float64)
        self._centre = self.corners.mean((0, 1))
        # The scene does not keep the mesh alive.
        self._mesh = EmbreeMesh(self._scene, (self.corners - self._centre).float().numpy())

    def first_hits(self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"]) -> Int[Tensor, "R"]:
        """Return the first triangle that each ray hits, -1 for none."""
        hits = self._scene.run((x - self._centre).float().numpy(), d.float().numpy())
        return torch.from_numpy(np.asarray(hits)).long()


def _share_plane(tree: scipy.spatial.KDTree, planes: Float[np.ndarray, "F 4"]) -> bool:
    """Return whether a plane, in either orientation, is one of the planes of a search tree."""
    # Tolerance of unit normals, and of heights as fractions of the extent.
    distances = [tree.query(sign * planes, distance_upper_bound=1e-3)[0] for sign in (1, -1)]
    return bool(np.isfinite(distances).any())


def layers(corners: Float[Tensor, "F 3 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F"]:
    """Assign triangles that may coincide to different layers.

    Patches (see `patches`) are in different layers if their bounding boxes overlap and some of their triangles are in
    one plane.

    Args:
        corners: corners of each triangle, world units.
        faces: vertex indices of each triangle.
    """
    patch, _ = patches(faces)
    order = np.argsort(patch, kind="stable")
    groups = [torch.from_numpy(g) for g in np.split(order, np.flatnonzero(np.diff(patch[order])) + 1)]
    boxes = torch.stack([torch.stack([corners[g].amin((0, 1)), corners[g].amax((0, 1))]) for g in groups])
    extent = (boxes[:, 1].amax(0) - boxes[:, 0].amin(0)).max()
    normals = torch.nn.functional.normalize(torch.linalg.cross(*corners.diff(dim=1).unbind(1)), dim=-1)
    heights = ((corners.mean(1) - boxes.mean((0, 1))) * normals).sum(-1, keepdim=True) / extent
    planes = [torch.cat([normals, heights], -1)[group].numpy() for group in groups]
    trees = [scipy.spatial.KDTree(plane) for plane in planes]
    members: list[list[int]] = []
    layer = np.empty(len(faces), np.int64)
    for number, (low, high) in enumerate(boxes - extent * torch.tensor([[1e-5], [-1e-5]])):
        for others in members:
            near = ((boxes[others, 0] <= high) & (boxes[others, 1] >= low)).all(1)
            if not any(_share_plane(trees[others[i]], planes[number]) for i in near.nonzero()[:, 0]):
                others.append(number)
                break
        else:
            members.append([number])
    for i, numbers in enumerate(members):
        layer[torch.cat([groups[number] for number in numbers]).numpy()] = i
    return layer


_MARGIN = 1e-9  # of boxes, so that rounding errors miss no triangle, as a fraction of the extent


class TriangleTree(NamedTuple):
    """Binary tree of bounding boxes, in which node i has the children 2 i + 1 and 2 i + 2.

    All leaves have the same depth and size; to fill them, some triangles occur twice.
    """

    boxes: Float[np.ndarray, "nodes 2 3"]  # lowest and highest corner of each node, world units
    leaves: Int[np.ndarray, "leaves size"]  # triangles of the last nodes
    leaf_corners: Float[np.ndarray, "leaves size 3 3"]  # their corners, in the order in which the search reads them
    # Corners, normals and body of each triangle, see `Triangles`, and its layer, see `intersection.layers`.
    corners: Float[np.ndarray, "F 3 3"]
    normals: Float[np.ndarray, "F 3 3"]
    body: Int[np.ndarray, "F"]
    layer: Int[np.ndarray, "F"]
    num_layers: int
    offset: float  # distance within which triangles count as met together, world units

    @classmethod
    def of(cls, triangles: Triangles, layer: Int[np.ndarray, "F"], offset: float) -> TriangleTree:
        """Build the tree by splitting the triangles of each node in halves along the longest side of their centres."""
        corners, levels = triangles.corners.numpy(), []
        number = len(corners)
        # A leaf has at least three triangles, and less than twice as many.
        num_leaves = 1 << max(0, math.floor(math.log2(number / 3)))
        num_entries = -(-number // num_leaves) * num_leaves
        order = (np.arange(num_entries) * number // num_entries)[None]
        while True:
            points = corners[order]
            levels.append(np.stack([points.min((1, 2)), points.max((1, 2))], 1))
            if len(order) == num_leaves:
                break
            centres = points.mean(2)
            axis = np.ptp(centres, axis=1).argmax(-1)
            along = np.take_along_axis(centres, axis[:, None, None], 2)[..., 0]
            halves = np.argpartition(along, order.shape[1] // 2, axis=1)
            order = np.take_along_axis(order, halves, 1).reshape(2 * len(order), -1)
        boxes = np.concatenate(levels) + _MARGIN * np.ptp(levels[0]) * np.array([[-1.0], [1.0]])
        normals, body = triangles.normals.numpy(), triangles.body.numpy()
        return cls(boxes, order, points, corners, normals, body, layer, int(layer.max()) + 1, offset)
