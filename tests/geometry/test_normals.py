"""Normals and orientation of meshes whose surface is known, and the choice of the normals in mesh files."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.normals import corner_normals
from nerfro.geometry.orientation import area_vectors
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.bend import bend
from tests.geometry.test_bodies import ball, box, mesh_of


def test_normals_of_an_irregular_sphere_are_exact() -> None:
    # Max's weights are exact when a vertex and its neighbours lie on one sphere, however unevenly.
    points = trimesh.creation.icosphere(3).vertices + 0.02 * np.random.default_rng(0).normal(size=(642, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    mesh = mesh_of(trimesh.convex.convex_hull(points))
    normals = corner_normals(mesh)
    np.testing.assert_allclose(normals, mesh.triangles, atol=1e-9)


def test_large_flat_faces_decide_the_normals_at_their_rims() -> None:
    # A cube with narrow chamfers of 22 degrees around its top, as a modeller would round it.
    corners = [
        (x, y, z) for z, half in ((0.0, 1.0), (0.9, 1.0), (0.92, 0.95)) for x in (-half, half) for y in (-half, half)
    ]
    mesh = mesh_of(trimesh.convex.convex_hull(np.array(corners)).subdivide().subdivide())
    top = np.isclose(mesh.triangles[..., 2], 0.92).all(1)
    normals = corner_normals(mesh)
    tilt = np.degrees(np.arccos(normals[top][..., 2].clip(-1, 1)))
    assert tilt.max() < 2.0


def test_creases_split_normals() -> None:
    mesh = mesh_of(trimesh.creation.box(extents=[1.0, 1.0, 1.0]))
    normals = corner_normals(mesh)
    flat = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    np.testing.assert_allclose(normals, np.repeat(flat[:, None], 3, axis=1), atol=1e-12)


TORUS_CUBE = "embedded:torus/mesh.ply"


def _write(path: Path, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> Path:
    trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False).export(path)
    return path


def _averages(shape: trimesh.Trimesh, weight: str) -> np.ndarray:
    """Average the normals of the triangles around each vertex."""
    weights = {"uniform": np.ones((len(shape.faces), 3)), "angle": shape.face_angles, "area": shape.area_faces[:, None]}
    terms = np.broadcast_to(weights[weight], shape.faces.shape)[..., None] * shape.face_normals[:, None]
    sums = np.stack([np.bincount(shape.faces.reshape(-1), terms[..., i].reshape(-1)) for i in range(3)], -1)
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _bevelled_box(half: float = 0.5, radius: float = 0.06) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a cube with edges rounded by three flat strips, and the normals of the round edges."""
    polar, azimuth = np.meshgrid(*[np.linspace(0, np.pi / 2, 4)] * 2)
    octant = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 1, 3)
    shape = trimesh.convex.convex_hull((signs * ((half - radius) + radius * octant.reshape(1, -1, 3))).reshape(-1, 3))
    normals = shape.vertices - np.clip(shape.vertices, radius - half, half - radius)
    return shape, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("interface", ["mesh", "sdf"])
@pytest.mark.parametrize("weight", ["uniform", "angle", "area"])
def test_averaged_normals_of_a_file_do_not_bend_rays_at_flat_sides(weight: str, interface: str, tmp_path: Path) -> None:
    box, _ = _bevelled_box()
    file = _write(tmp_path / "box.ply", box.vertices, box.faces, _averages(box, weight))
    generator = np.random.default_rng(0)
    tilt, azimuth = np.radians(generator.uniform(0, 25, 500)), generator.uniform(0, 2 * np.pi, 500)
    towards = np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)], -1)
    entry = np.concatenate([generator.uniform(-0.2, 0.2, (500, 2)), np.full((500, 1), 0.5)], axis=1)
    exits = bend(file, 1.5, entry - 2 * towards, towards, interface).directions.numpy()
    assert np.degrees(np.linalg.norm(exits - towards, axis=1)).mean() < 0.35


def test_normals_of_smooth_shapes_are_kept(tmp_path: Path) -> None:
    ball, scale = trimesh.creation.icosphere(2), np.array([2.0, 1.0, 0.5])
    points = np.random.default_rng(0).normal(size=(300, 3))
    irregular = trimesh.convex.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    for shape in (ball, trimesh.creation.uv_sphere(count=[12, 24]), irregular):
        normals = shape.vertices / scale / np.linalg.norm(shape.vertices / scale, axis=1, keepdims=True)
        mesh = load_mesh(_write(tmp_path / "ellipsoid.ply", shape.vertices * scale, shape.faces, normals))
        corners = mesh.triangles / scale**2
        exact = corners / np.linalg.norm(corners, axis=-1, keepdims=True)
        np.testing.assert_allclose(mesh.normals, exact, atol=1e-6)
    box, normals = _bevelled_box()
    assert load_mesh(_write(tmp_path / "box.ply", box.vertices, box.faces, normals)).normals is not None


def test_face_normals_in_a_file_do_not_make_facets(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3)
    vertices, faces = ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3)
    mesh = load_mesh(_write(tmp_path / "ball.ply", vertices, faces, np.repeat(ball.face_normals, 3, axis=0)))
    np.testing.assert_allclose(corner_normals(mesh), mesh.triangles, atol=1e-6)


def test_normals_that_contradict_the_faces_are_ignored(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3)
    wrong = np.tile([0.0, 0.0, 1.0], (len(ball.vertices), 1))
    trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=wrong, process=False).export(tmp_path / "ball.ply")
    mesh = load_mesh(tmp_path / "ball.ply")
    faces = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals
    facing = (corner_normals(mesh) * faces[:, None]).sum(-1)
    assert facing.min() > np.cos(np.radians(31))


def test_large_flat_faces_of_the_embedded_cube_are_flat_in_the_distance() -> None:
    medium = make_bodies(TORUS_CUBE, resolution=64, cache=False)
    across = torch.linspace(-0.55, 0.55, 12)
    x, y = torch.meshgrid(across, across, indexing="ij")
    phi, gradient = medium.signed_distances(torch.stack([x, y, torch.full_like(x, 0.75)], -1).reshape(-1, 3))
    assert phi.abs().max() < 1e-4
    tilt = gradient[:, 0, :2].norm(dim=-1) / gradient[:, 0, 2]
    assert tilt.max() < 1e-3


@pytest.mark.parametrize("winding", ["outwards", "inwards", "random"])
@pytest.mark.parametrize(
    ("parts", "signs"),
    [
        ([ball(1.0)], [1]),
        ([ball(1.0), ball(0.5)], [1, -1]),
        ([ball(1.0), ball(0.5), ball(0.2, 0.1), ball(0.1, -0.8)], [1, -1, 1, -1]),
        ([trimesh.creation.torus(1.0, 0.3), ball(0.6)], [1, 1]),  # in the hole, which is outside
        ([box(0.5), box(0.5, 0.5, 0.5)], [1, 1]),  # an edge in common
        ([box(0.5), box(0.3, 0.05)], [1, -1]),
    ],
)
def test_signed_volumes_follow_the_nesting(
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


def test_normals_of_the_file_are_flipped_with_the_triangles(tmp_path: Path) -> None:
    shape = ball(1.0)
    normals = -np.asarray(shape.vertices)
    trimesh.Trimesh(shape.vertices, shape.faces[:, ::-1], vertex_normals=normals, process=False).export(
        tmp_path / "ball.ply"
    )
    mesh = load_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(mesh.normals, mesh.triangles, atol=1e-6)
