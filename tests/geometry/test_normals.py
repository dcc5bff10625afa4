"""Normals and orientation of meshes whose surface is known, and facets, which keep sharp edges."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import HalfspaceIntersection

from nerfro.geometry.facets import facets_of
from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.normals import corner_normals
from nerfro.geometry.orientation import area_vectors
from nerfro.media.body_settings import expanded, make_bodies
from nerfro.media.surfaces import MeshSurface
from nerfro.samplers.paths.bend import bend
from tests.conftest import refused
from tests.exact_facets import exit_directions
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


def _rings(*rings: tuple[float, float], sides: int) -> trimesh.Trimesh:
    """Return the convex hull of regular polygons around z, of which radius and height are given."""
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    return trimesh.convex.convex_hull(np.concatenate([r * circle + [0, 0, z] for r, z in rings]))


def _brilliant() -> trimesh.Trimesh:
    """Return a round stone: table, stars, kites and upper halves above the girdle, mains and lower halves below."""
    planes = [(0.0, 0.0, 1.0, -0.32)]
    for sides, first, polar, distance in (
        (8, 0.0, 34, 0.70), (8, 0.5, 20, 0.50), (16, 0.5, 41, 0.755), (16, 0.5, 90, 1.0), (8, 0.0, 139, 0.62),
        (16, 0.5, 137, 0.655),
    ):  # fmt: skip
        angle, tilt = (np.arange(sides) + first) * 2 * np.pi / sides, np.radians(polar)
        planes += [(np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt), -distance) for a in angle]
    return trimesh.convex.convex_hull(HalfspaceIntersection(np.array(planes), np.zeros(3)).intersections)


def _stone(subdivisions: int) -> trimesh.Trimesh:
    """Return a smooth, irregular stone, sampled by triangles as in a scan."""
    shape, generator = trimesh.creation.icosphere(subdivisions), np.random.default_rng(0)
    waves = 2 * generator.normal(size=(8, 3))
    shape.vertices *= 1 + 0.05 * np.cos(shape.vertices @ waves.T + generator.uniform(0, 6, 8)).sum(1)[:, None]
    return shape


def _fibonacci_stone() -> trimesh.Trimesh:
    """Return a stone of 96 faces without symmetry."""
    number = np.arange(96) + 0.5
    z, turn = 1 - number / 48, np.pi * (1 + 5**0.5) * number
    radius = np.sqrt(1 - z**2)
    planes = np.stack([radius * np.cos(turn), radius * np.sin(turn), z, np.full(96, -1.0)], -1)
    return trimesh.convex.convex_hull(HalfspaceIntersection(planes, np.zeros(3)).intersections)


CUT = {
    "brilliant": _brilliant,
    "96 faces": _fibonacci_stone,
    "step cut": lambda: _rings((0.5, 0.35), (0.8, 0.22), (1, 0), (1, -0.05), (0.05, -0.8), sides=24),
    "prism": lambda: _rings((0.7, -0.6), (0.7, 0.6), sides=3),
    "octagon block": lambda: _rings((0.7, -0.4), (0.7, 0.4), sides=8),
    "tumbler": lambda: _rings((0.5, -0.6), (0.6, 0.6), sides=20),
}
SMOOTH = {
    "ball": lambda: trimesh.creation.icosphere(2),
    "ellipsoid": lambda: trimesh.creation.icosphere(2).apply_transform(np.diag([1, 0.6, 0.4, 1])),
    "globe": lambda: trimesh.creation.uv_sphere(count=[12, 24]),
    "stone": lambda: _stone(3),
    "coarse stone": lambda: _stone(2),
    "rod": lambda: _rings((0.5, -0.6), (0.5, 0.6), sides=64),
}


def _rays(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(1)
    origins = generator.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    towards = generator.uniform(-0.3, 0.3, (count, 3)) - origins
    return origins, towards / np.linalg.norm(towards, axis=1, keepdims=True)


def _errors(file: Path, **settings: object) -> np.ndarray:
    """Return the error of exit directions behind flat triangles, degrees."""
    origins, towards = _rays()
    exact = exit_directions(load_mesh(file).triangles, 1.5, origins, towards)
    exits = bend(file, 1.5, origins, towards, resolution=16, **settings).directions.numpy()  # type: ignore[arg-type]
    left = np.isfinite(exact).all(1)
    assert left.mean() > 0.5
    return np.degrees(np.linalg.norm(exits - exact, axis=1))[left]


@pytest.mark.parametrize("shape", CUT)
def test_rays_through_facets_are_exact(shape: str, tmp_path: Path) -> None:
    file = tmp_path / "cut.ply"
    CUT[shape]().export(file)
    error = _errors(file)
    assert np.median(error) < 1e-4
    # Rays through an edge may take the other facet.
    assert np.quantile(error, 0.99) < 1e-3


@pytest.mark.parametrize("shape", SMOOTH)
def test_samples_of_smooth_surfaces_are_no_facets(
    shape: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "smooth.ply"
    SMOOTH[shape]().export(file)
    assert MeshSurface(str(file)).mesh.facets is None
    assert "warning" not in capsys.readouterr().out


def _rounded_plate() -> trimesh.Trimesh:
    """Return a flat cylinder with large flat sides and rounded rims."""
    angle = np.linspace(0, np.pi / 2, 7)
    rim = [(0.9 + 0.1 * np.sin(a), 0.4 + 0.1 * np.cos(a)) for a in angle]
    return _rings(*rim, *((r, -z) for r, z in rim), sides=40)


def test_rounded_edges_between_flat_sides_stay_smooth() -> None:
    mesh = mesh_of(_rounded_plate())
    assert (facets_of(mesh.vertices, mesh.faces).number < 0).all()


@pytest.mark.parametrize(("sides", "shading"), [(20, "flat"), (32, "smooth")])
def test_ambiguous_sides_are_named(
    sides: int, shading: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "tumbler.ply"
    _rings((0.5, -0.6), (0.6, 0.6), sides=sides).export(file)
    for _ in range(2):
        MeshSurface(str(file))
    out = capsys.readouterr().out
    assert out.count("warning") == 1
    assert f"tumbler.ply: {sides} flat faces that meet at about" in out
    assert f"traced as {shading}" in out
    MeshSurface(str(file), shading="flat")
    assert "warning" not in capsys.readouterr().out


def test_settings_of_a_body_decide(tmp_path: Path) -> None:
    ball, tumbler = str(tmp_path / "ball.ply"), str(tmp_path / "tumbler.ply")
    CUT["tumbler"]().export(tumbler)
    SMOOTH["ball"]().export(ball)

    def tilt(**settings: object) -> float:
        """Return the largest angle between the normal of a corner and of its triangle, degrees."""
        medium = make_bodies(resolution=16, cache=False, **settings)  # type: ignore[arg-type]
        mesh = medium.meshes[0]
        flat = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        sine = np.linalg.norm(np.cross(corner_normals(mesh), flat[:, None]), axis=-1)
        return float(np.degrees(np.arcsin(sine)).max())

    def of_body(**settings: object) -> dict[str, object]:
        return {"bodies": {"cut": {"ior": 1.5, **settings}}}

    assert tilt(mesh=tumbler) < 1e-3
    assert tilt(mesh=tumbler, shading="smooth") == pytest.approx(9, abs=0.2)
    assert tilt(mesh=tumbler, crease_degrees=20) == pytest.approx(9, abs=0.2)
    assert tilt(mesh=tumbler, crease_degrees=10) < 1e-3
    assert tilt(mesh=ball) > 5
    assert tilt(mesh=ball, shading="flat") < 1e-9
    assert tilt(**of_body(mesh=ball, shading="flat")) < 1e-9
    assert tilt(**of_body(mesh=tumbler, crease_degrees=20), shading="flat") > 5
    refused("crease_degrees=20 contradicts shading=flat", MeshSurface, ball, shading="flat", crease_degrees=20.0)
    box = {"name": "box", "sides": [1.0, 1.0, 1.0]}
    refused("belong to its surface", make_bodies, **of_body(surface=box, shading="flat"))
    refused("shading", expanded, of_body(mesh=ball, shading="round"))


@pytest.mark.parametrize("normals", ["faces", "averages"])
def test_normals_of_a_file_leave_facets_flat(normals: str, tmp_path: Path) -> None:
    shape, file = _brilliant(), tmp_path / "cut.ply"
    if normals == "faces":
        corners = np.arange(3 * len(shape.faces)).reshape(-1, 3)
        repeated = np.repeat(shape.face_normals, 3, axis=0)
        shape = trimesh.Trimesh(shape.triangles.reshape(-1, 3), corners, vertex_normals=repeated, process=False)
    else:
        shape = trimesh.Trimesh(shape.vertices, shape.faces, vertex_normals=shape.vertex_normals, process=False)
    shape.export(file)
    assert np.quantile(_errors(file), 0.99) < 1e-3
