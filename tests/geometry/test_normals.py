"""Normals of meshes whose surface is known."""

from __future__ import annotations

import numpy as np
import trimesh

from nerfro.geometry.mesh import TriangleMesh, merge_vertices
from nerfro.geometry.normals import corner_normals


def _mesh(shape: trimesh.Trimesh) -> TriangleMesh:
    return merge_vertices(np.asarray(shape.vertices, np.float64), np.asarray(shape.faces))


def test_normals_of_an_irregular_sphere_are_exact() -> None:
    # Max's weights are exact when a vertex and its neighbours lie on one sphere, however unevenly.
    points = trimesh.creation.icosphere(3).vertices + 0.02 * np.random.default_rng(0).normal(size=(642, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    mesh = _mesh(trimesh.convex.convex_hull(points))
    normals = corner_normals(mesh)
    np.testing.assert_allclose(normals, mesh.triangles, atol=1e-9)


def test_large_flat_faces_decide_the_normals_at_their_rims() -> None:
    # A cube with narrow chamfers of 22 degrees around its top, as a modeller would round it.
    corners = [
        (x, y, z) for z, half in ((0.0, 1.0), (0.9, 1.0), (0.92, 0.95)) for x in (-half, half) for y in (-half, half)
    ]
    mesh = _mesh(trimesh.convex.convex_hull(np.array(corners)).subdivide().subdivide())
    top = np.isclose(mesh.triangles[..., 2], 0.92).all(1)
    normals = corner_normals(mesh)
    tilt = np.degrees(np.arccos(normals[top][..., 2].clip(-1, 1)))
    assert tilt.max() < 2.0


def test_creases_split_normals() -> None:
    mesh = _mesh(trimesh.creation.box(extents=[1.0, 1.0, 1.0]))
    normals = corner_normals(mesh)
    flat = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    np.testing.assert_allclose(normals, np.repeat(flat[:, None], 3, axis=1), atol=1e-12)
