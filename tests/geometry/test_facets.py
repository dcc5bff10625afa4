"""Facets of cut stones keep sharp edges, and samples of smooth surfaces do not."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import HalfspaceIntersection

from nerfro.geometry.facets import facets_of
from nerfro.geometry.mesh import load_mesh
from nerfro.geometry.normals import corner_normals
from nerfro.media.body_settings import expanded, make_bodies
from nerfro.media.surfaces import MeshSurface
from nerfro.samplers.paths.bend import bend
from tests.conftest import refused
from tests.exact_facets import exit_directions
from tests.geometry.test_bodies import mesh_of


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
