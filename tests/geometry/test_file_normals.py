"""A modeller's normals are kept: faces that are flat in the file stay flat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import trimesh

from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.normals import corner_normals
from nerfro.media.sdf_grid import SdfGrid

TORUS_CUBE = "embedded:torus/mesh.ply"


def test_normals_of_the_file_are_taken_and_averages_are_not(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    exact = np.asarray(ball.vertices)
    trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=exact, process=False).export(tmp_path / "ball.ply")
    mesh = load_mesh(tmp_path / "ball.ply")
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(corner_normals(mesh), corners, atol=1e-6)


def test_normals_that_contradict_the_faces_are_not_trusted(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3)
    wrong = np.tile([0.0, 0.0, 1.0], (len(ball.vertices), 1))
    trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=wrong, process=False).export(tmp_path / "ball.ply")
    mesh = load_mesh(tmp_path / "ball.ply")
    faces = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals
    facing = (corner_normals(mesh) * faces[:, None]).sum(-1)
    assert facing.min() > np.cos(np.radians(31))


def test_large_flat_faces_of_the_embedded_cube_are_flat_in_the_distance() -> None:
    medium = SdfGrid(TORUS_CUBE, resolution=64, cache=False)
    across = torch.linspace(-0.55, 0.55, 12)
    x, y = torch.meshgrid(across, across, indexing="ij")
    phi, gradient = medium.signed_distances(torch.stack([x, y, torch.full_like(x, 0.75)], -1).reshape(-1, 3))
    assert phi.abs().max() < 1e-4
    tilt = gradient[:, 0, :2].norm(dim=-1) / gradient[:, 0, 2]
    assert tilt.max() < 1e-3
