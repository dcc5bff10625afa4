"""Closed surfaces of one mesh: crossing surfaces are refused, others are accepted."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from nerfro.geometry.bodies import bodies_of, require_separate, require_simple
from nerfro.geometry.mesh import TriangleMesh, load_mesh, merge_vertices
from nerfro.media.base import Medium
from nerfro.media.body_settings import make_bodies
from nerfro.paper.voxel_grid import VoxelGrid
from tests.conftest import refused

BOX = {"box_min": [-1.5] * 3, "box_max": [1.5] * 3, "resolution": 24, "cache": False}


def ball(radius: float, x: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(2, radius).apply_translation((x, 0, 0))


def mesh_of(*parts: trimesh.Trimesh) -> TriangleMesh:
    whole = trimesh.util.concatenate(parts)
    return merge_vertices(np.asarray(whole.vertices), np.asarray(whole.faces))


def box(size: float, x: float = 0.0, y: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box((size, size, size)).apply_translation((x, y, 0))


@pytest.mark.parametrize(
    "parts",
    [
        [ball(0.5)],
        [ball(0.5, -0.6), ball(0.5, 0.6)],
        [ball(0.6), ball(0.3)],
        [ball(0.6), ball(0.3, -0.2), ball(0.1, 0.3)],
        [box(0.5), box(0.5, 0.5)],  # side by side
        [box(0.5), box(0.3, 0.4)],
        [box(0.5), box(0.2, 0.1)],
        [box(0.5), box(0.3, 0.1)],  # inside, against the wall
        [box(0.5), box(0.5, 0.5).apply_translation((0, 0.2, 0))],
        [ball(0.3), *(ball(0.01, x) for x in np.linspace(-0.25, 0.25, 9))],
    ],
)
def test_separate_nested_and_touching_surfaces_are_accepted(parts: list[trimesh.Trimesh]) -> None:
    require_separate(mesh_of(*parts))


@pytest.mark.parametrize(
    "parts",
    [
        [ball(0.5, -0.2), ball(0.45, 0.2)],
        [ball(0.3), trimesh.creation.box((2, 0.01, 0.01))],  # a needle through it: no vertex is inside the other
        [box(0.5), box(0.5, 0.2).apply_translation((0, 0.1, 0.07))],
        [ball(0.2, -1.0), ball(0.2, -0.5), ball(0.3, 0.5), ball(0.25, 0.6)],
        # Their edges meet in edges and in common planes alone.
        [box(0.5), box(0.5, 0.2)],
        [box(0.5), box(0.5, 0.01)],
        [box(0.5), trimesh.creation.box((0.5, 0.2, 0.2)).apply_translation((0.1, 0, 0))],
        [box(0.5), trimesh.creation.box((1, 0.5, 0.2))],
        [ball(0.5), ball(0.5, 0.01)],
        [ball(0.5, -0.2), ball(0.5, 0.2)],
        # A copy that is moved by less than what counts as touching, beside another body.
        [ball(0.2, -0.5), ball(0.3, 0.5), ball(0.3, 0.5 + 1e-7)],
    ],
)
def test_intersecting_surfaces_are_refused(parts: list[trimesh.Trimesh]) -> None:
    mesh = mesh_of(*parts)
    assert bodies_of(mesh).max() == len(parts) - 1
    refused("closed surfaces of the mesh cross", require_separate, mesh)


def _coil(turn: float, count: int = 48, sides: int = 12) -> trimesh.Trimesh:
    """Return a closed tube around a flat helix; beyond 360 degrees its ends overlap."""
    angle = np.linspace(0, np.radians(turn), count)[:, None]
    around = np.arange(sides) * 2 * np.pi / sides
    radius, height = 0.6 + 0.25 * np.cos(around), 0.25 * np.sin(around) + 0.04 * angle
    rings = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    ends = np.stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.04 * angle], -1)[[0, -1], 0]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    side = np.concatenate([np.stack([a, a + sides, b], -1), np.stack([b, a + sides, b + sides], -1)]).reshape(-1, 3)
    rim, last = np.arange(sides), (count - 1) * sides
    after = (rim + 1) % sides
    first = np.stack([np.full(sides, count * sides), rim, after], -1)
    end = np.stack([np.full(sides, count * sides + 1), last + after, last + rim], -1)
    return trimesh.Trimesh(np.concatenate([rings.reshape(-1, 3), ends]), np.concatenate([side, first, end]))


def test_surface_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    for turn in (300, 400):
        _coil(turn).export(tmp_path / f"{turn}.ply")
        assert load_mesh(tmp_path / f"{turn}.ply").is_closed
    make_bodies(str(tmp_path / "300.ply"), resolution=16, cache=False)
    for medium in (make_bodies, VoxelGrid):
        refused("the surface of the mesh crosses itself", medium, str(tmp_path / "400.ply"), **BOX)
    # The largest triangles lie inside the other end of the tube; the second mesh has its front inside.
    fine = _coil(400, 160, 48)
    for faces in (fine.faces, fine.faces[:, ::-1]):
        refused("crosses itself", require_simple, mesh_of(trimesh.Trimesh(fine.vertices, faces)))
    # A dent of a ball that sticks out on the other side.
    dented = ball(1.0)
    top = dented.vertices[:, 2] > 0.9
    dented.vertices[top, 2] -= 26 * (dented.vertices[top, 2] - 0.9)
    refused("crosses itself", require_simple, mesh_of(dented))


def test_nested_and_touching_surfaces_do_not_cross_themselves(tmp_path: Path) -> None:
    shapes = [
        [ball(0.6), ball(0.3, -0.2), ball(0.1, 0.3)], [box(0.5), box(0.5, 0.5)], [box(0.5), box(0.5, 0.5, 0.5)],
        [trimesh.creation.torus(1.0, 0.3), ball(0.6)],
    ]  # fmt: skip
    for number, parts in enumerate(shapes):
        trimesh.util.concatenate(parts).export(tmp_path / f"{number}.ply")
        require_simple(load_mesh(tmp_path / f"{number}.ply"))


@pytest.mark.parametrize("medium", [make_bodies, VoxelGrid])
def test_duplicate_surface_counts_once(medium: Callable[..., Medium], tmp_path: Path) -> None:
    ball(0.6).export(tmp_path / "once.ply")
    trimesh.util.concatenate([ball(0.6), ball(0.6)]).export(tmp_path / "twice.ply")
    once, twice = (medium(str(tmp_path / f"{name}.ply"), **BOX) for name in ("once", "twice"))
    buffers = dict(once.named_buffers())
    assert sum(values.numel() for values in buffers.values()) >= 24**3
    for name, values in buffers.items():
        assert values.equal(dict(twice.named_buffers())[name]), name


@pytest.mark.parametrize("medium", [make_bodies, VoxelGrid])
@pytest.mark.parametrize("shape", ["flat", "both ways", "thin"])
def test_mesh_without_an_interior_is_refused(medium: Callable[..., Medium], shape: str, tmp_path: Path) -> None:
    mesh = ball(0.6)
    if shape == "flat":
        normal = np.array([1.0, 2.0, 3.0]) / 14**0.5
        mesh.vertices -= np.outer(mesh.vertices @ normal, normal)
    elif shape == "both ways":
        faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
        mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    else:
        mesh = trimesh.creation.box((0.5, 0.5, 0.001)).apply_translation((0, 0, 0.03))
    mesh.export(tmp_path / "mesh.ply")
    refused("no vertex of the grid lies inside the mesh", medium, str(tmp_path / "mesh.ply"), **BOX)


def test_thin_plate_is_loaded_in_any_world_unit(tmp_path: Path) -> None:
    for size in (2.0**-10, 2.0**10):
        trimesh.creation.box((1.5 * size, 1.5 * size, 0.09 * size)).export(tmp_path / "plate.ply")
        assert load_mesh(tmp_path / "plate.ply").is_closed
    trimesh.creation.box((1.5, 1.5, 1e-5)).export(tmp_path / "plate.ply")
    refused("1e-05 world units thin and 1.5 long, so it has no inside", load_mesh, tmp_path / "plate.ply")


@pytest.mark.parametrize("medium", [make_bodies, VoxelGrid])
def test_open_mesh_is_accepted_on_request(medium: Callable[..., Medium], tmp_path: Path) -> None:
    mesh = ball(0.6)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "mesh.ply")
    index, _ = medium(str(tmp_path / "mesh.ply"), accept_open_mesh=True, **BOX)(torch.zeros(1, 3))
    assert float(index) > 1.2


@pytest.mark.parametrize("scale", [1e8, 1e30])
def test_too_large_mesh_is_refused(scale: float, tmp_path: Path) -> None:
    ball(scale).export(tmp_path / "mesh.ply")
    refused("reaches too far; scale it to about one unit", load_mesh, tmp_path / "mesh.ply")
