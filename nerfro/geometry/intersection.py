"""Rays against triangles, by Embree's bounding volume hierarchy."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.normals import corner_normals, face_normals


class MeshIntersector:
    """First hits of rays with the surfaces of several bodies.

    Attributes:
        triangles: of all bodies, world units.
        normals: unit normal at each corner, split at creases.
        face_normals: unit normal of each triangle.
        body: which body each triangle belongs to.
    """

    def __init__(self, meshes: list[TriangleMesh], crease_degrees: float) -> None:
        """Build the hierarchy.

        Raises:
            NerfroError: embreex is not installed.
        """
        try:
            from embreex.mesh_construction import TriangleMesh as EmbreeMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise NerfroError("sampler.path.interface=mesh needs Embree; pip install embreex, or take =sdf") from error
        self.triangles = torch.from_numpy(np.concatenate([mesh.triangles for mesh in meshes]))
        self.normals = torch.from_numpy(np.concatenate([corner_normals(mesh, crease_degrees) for mesh in meshes]))
        self.face_normals = torch.from_numpy(np.concatenate([face_normals(mesh) for mesh in meshes]))
        self.body = torch.from_numpy(np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]))
        self._scene = EmbreeScene()
        # The scene keeps a pointer to the mesh, not the mesh.
        self._mesh = EmbreeMesh(self._scene, self.triangles.float().numpy())

    def first_hits(self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"]) -> Int[Tensor, "R"]:
        """Triangle that each ray hits first, -1 for none."""
        hits = self._scene.run(x.float().numpy(), d.float().numpy())
        return torch.from_numpy(np.asarray(hits)).long()

    def distance(self, x: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"], face: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
        """Distance to a triangle's plane along a ray, in double precision."""
        normal = self.face_normals[face]
        slope = (d * normal).sum(-1)
        return ((self.triangles[face, 0] - x) * normal).sum(-1) / slope

    def normal(self, x: Float[Tensor, "R 3"], face: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Unit normal at points of triangles: the corners' normals, weighted with the barycentric coordinates."""
        corners = self.triangles[face]
        areas = [torch.linalg.cross(corners[:, (i + 1) % 3] - x, corners[:, (i + 2) % 3] - x) for i in range(3)]
        weights = torch.stack([(area * self.face_normals[face]).sum(-1) for area in areas], -1)
        weights = (weights / weights.sum(-1, keepdim=True)).clamp(0, 1)
        return torch.nn.functional.normalize((weights[..., None] * self.normals[face]).sum(1), dim=-1)
