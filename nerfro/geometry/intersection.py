"""Intersection of rays and triangles with Embree's bounding volume hierarchy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import smooth_normals


@dataclass(frozen=True)
class Triangles:
    """Triangles of several bodies in double precision, differentiable with respect to the vertices.

    Attributes:
        corners: corners of each triangle, world units.
        normals: unit normal at each corner, split at creases.
        body: number of the body of each triangle.
    """

    corners: Float[Tensor, "F 3 3"]
    normals: Float[Tensor, "F 3 3"]
    body: Int[Tensor, "F"]

    @classmethod
    def of(cls, meshes: list[TriangleMesh], vertices: Float[Tensor, "V 3"] | None = None) -> Triangles:
        """Collect the triangles of meshes, with smooth normals up to the crease angle.

        Args:
            meshes: one mesh per body.
            vertices: vertices of all meshes together that replace the vertices of the meshes, world units.
        """
        counts = [len(mesh.vertices) for mesh in meshes]
        if vertices is None:
            vertices = torch.from_numpy(np.concatenate([mesh.vertices for mesh in meshes]))
        parts = vertices.double().cpu().split(counts)
        corners = [part[torch.from_numpy(mesh.faces)] for mesh, part in zip(meshes, parts, strict=True)]
        normals = [smooth_normals(mesh, part) for mesh, part in zip(meshes, corners, strict=True)]
        body = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        return cls(torch.cat(corners), torch.cat(normals), torch.from_numpy(body))

    def areas(self, face: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Return normals by the right-hand rule, with a length of twice the area of the triangle."""
        a, b, c = self.corners[face].unbind(1)
        return torch.linalg.cross(b - a, c - a)

    def distance(self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"], face: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
        """Return the distance to a triangle's plane along each ray."""
        normal = self.areas(face)
        return ((self.corners[face, 0] - x) * normal).sum(-1) / (d * normal).sum(-1)

    def normal(self, x: Float[Tensor, "R 3"], face: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Interpolate unit normals at points of triangles with barycentric coordinates."""
        corners, normal = self.corners[face], self.areas(face)
        areas = [torch.linalg.cross(corners[:, (i + 1) % 3] - x, corners[:, (i + 2) % 3] - x) for i in range(3)]
        weights = torch.stack([(area * normal).sum(-1) for area in areas], -1)
        weights = (weights / weights.sum(-1, keepdim=True)).clamp(0, 1)
        return torch.nn.functional.normalize((weights[..., None] * self.normals[face]).sum(1), dim=-1)


class MeshIntersector:
    """First hits of rays with triangles, which are given by the corners."""

    def __init__(self, corners: Float[Tensor, "F 3 3"] | Float[np.ndarray, "F 3 3"]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh as EmbreeMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise NerfroError(
                f"intersections with triangles need Embree ({error}); pip install embreex (no wheel for Linux on "
                "ARM), or set sampler.path.interface=sdf"
            ) from error
        self._scene = EmbreeScene()
        # The scene does not keep the mesh alive.
        self._mesh = EmbreeMesh(self._scene, np.asarray(corners, np.float32))

    def first_hits(self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"]) -> Int[Tensor, "R"]:
        """Return the first triangle that each ray hits, -1 for none."""
        hits = self._scene.run(x.float().numpy(), d.float().numpy())
        return torch.from_numpy(np.asarray(hits)).long()
