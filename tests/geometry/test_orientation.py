"""Triangles of a mesh file face the outside, as parity defines it, whatever the winding in the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.orientation import area_vectors


def _ball(radius: float, x: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(2, radius).apply_translation((x, 0, 0))


def _box(size: float, x: float = 0.0, y: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box((size, size, size)).apply_translation((x, y, 0))


@pytest.mark.parametrize("winding", ["outwards", "inwards", "random"])
@pytest.mark.parametrize(
    ("parts", "signs"),
    [
        ([_ball(1.0)], [1]),
        ([_ball(1.0), _ball(0.5)], [1, -1]),
        ([_ball(1.0), _ball(0.5), _ball(0.2, 0.1), _ball(0.1, -0.8)], [1, -1, 1, -1]),
        ([trimesh.creation.torus(1.0, 0.3), _ball(0.6)], [1, 1]),  # in the hole, which is outside
        ([_box(0.5), _box(0.5, 0.5, 0.5)], [1, 1]),  # an edge in common
        ([_box(0.5), _box(0.3, 0.05)], [1, -1]),
    ],
)
def test_signed_volumes_are_those_of_the_nesting(
    parts: list[trimesh.Trimesh], signs: list[int], winding: str, tmp_path: Path
) -> None:
    shape = trimesh.util.concatenate(parts)
    share = {"outwards": 0.0, "inwards": 1.0, "random": 0.5}[winding]
    reversed_ = np.random.default_rng(0).random(len(shape.faces)) < share
    faces = np.where(reversed_[:, None], shape.faces[:, ::-1], shape.faces)
    trimesh.Trimesh(shape.vertices, faces, process=False).export(tmp_path / "shape.ply")
    triangles = load_mesh(tmp_path / "shape.ply").triangles
    volume = (triangles[:, 0] * area_vectors(triangles)).sum() / 6
    assert volume == pytest.approx(sum(sign * part.volume for sign, part in zip(signs, parts, strict=True)), rel=1e-5)


def test_normals_of_the_file_turn_with_the_triangles(tmp_path: Path) -> None:
    ball = _ball(1.0)
    normals = -np.asarray(ball.vertices)
    trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], vertex_normals=normals, process=False).export(
        tmp_path / "ball.ply"
    )
    mesh = load_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(mesh.normals, mesh.triangles, atol=1e-6)
