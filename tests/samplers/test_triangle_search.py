"""The search for triangles: against all triangles one by one, on edges, and without Embree."""

import math
import sys
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
import trimesh

from nerfro.core.types import Rays
from nerfro.geometry.intersection import Triangles, TriangleTree
from nerfro.kernels.compilation import compiled_parallel
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.snell_cpu import Scratch
from nerfro.samplers.paths.surface_search_cpu import Line, end_of_blocks
from nerfro.samplers.paths.triangle_search_cpu import FARTHEST, first_triangle
from tests.closed_forms import make_rays, random_rays


@compiled_parallel
def _first_triangles(tree, scratch, origins, directions, lengths):  # type: ignore[no-untyped-def]
    for i in range(len(origins)):
        x, d = origins[i], directions[i]
        lengths[i] = first_triangle(tree, scratch, Line(x[0], x[1], x[2], d[0], d[1], d[2]), FARTHEST)[2]


def _lengths(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    triangles = Triangles(torch.tensor(corners), torch.zeros(corners.shape), torch.zeros(len(corners)).long())
    tree = TriangleTree.of(triangles, np.zeros(len(corners), np.int64), 1e-6)
    one, number = np.empty(1), np.empty(1, np.int64)
    scratch = Scratch(
        np.empty(1, np.bool_), one, np.empty((0, 8)), np.empty((0, 5), np.int64), np.empty((0, 1), np.bool_),
        number, one.copy(), np.empty(64, np.int64), np.empty(64),
    )  # fmt: skip
    lengths = np.empty(len(origins))
    _first_triangles(tree, scratch, origins, directions, lengths)
    return lengths


@pytest.mark.parametrize("count", [1, 2, 7, 500])
def test_tree_finds_the_nearest_of_all_triangles(count: int) -> None:
    generator = np.random.default_rng(count)
    corners = generator.normal(size=(count, 1, 3)) + 0.3 * generator.normal(size=(count, 3, 3))
    origins = 3 * generator.normal(size=(400, 3))
    directions = corners[generator.integers(count, size=400)].mean(1) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # x + t d = a + second u + third v
    system = np.stack(np.broadcast_arrays(-directions[:, None], u[None], v[None]), -1)
    t, second, third = np.moveaxis(np.linalg.solve(system, (origins[:, None] - a)[..., None])[..., 0], -1, 0)
    hit = (second >= 0) & (third >= 0) & (second + third <= 1) & (t > 1e-6)
    expected = np.where(hit, t, np.inf).min(1)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(_lengths(corners, origins, directions), expected, rtol=1e-9)


def test_rays_through_edges_corners_and_along_axes_meet_a_closed_surface() -> None:
    """Such rays are in the planes of faces of bounding boxes, and on the borders of triangles."""
    shape = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
    corners = np.array(shape.triangles)
    targets = np.concatenate([shape.vertices, shape.vertices[shape.edges_unique].mean(1)])
    above = targets[(targets[:, 2] == 1) & (np.abs(targets[:, :2]) < 1).all(1)] + np.array([0, 0, 2])
    np.testing.assert_allclose(_lengths(corners, above, np.tile([0.0, 0, -1], (len(above), 1))), 2)
    np.testing.assert_allclose(_lengths(corners, np.zeros_like(targets), targets), 1, rtol=1e-9)


def test_triangles_are_traced_without_embree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.ply")
    medium = make_bodies(str(tmp_path / "box.ply"), 1.5, resolution=16, cache=False)
    trace = Snell("mesh").trace(random_rays(100, 0.4, seed=0, far=4).to(torch.float32), medium)
    assert trace.path.refracted.all()


def test_triangles_are_traced_beside_the_training(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.ply")
    assert Snell("mesh").releases_gil(make_bodies(str(tmp_path / "box.ply"), 1.5, resolution=16, cache=False))


def _stacked_boxes(folder: Path, gap: float, iors: tuple[float, float]) -> Bodies:
    bodies = {}
    for name, z, ior in zip(("lower", "upper"), (0.0, 1 + gap), iors, strict=True):
        file = folder / f"{name}_{gap}.ply"
        trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix([0, 0, z])).export(file)
        bodies[name] = {"mesh": str(file), "ior": ior}
    return make_bodies(bodies=bodies, resolution=16, cache=False)


def _upward_rays(number: int, steepness: float) -> Rays:
    """Make rays that begin within the lower box of `_stacked_boxes`."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(number, 3)) * [1, 1, steepness] + np.array([0, 0, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = torch.tensor(generator.uniform(-0.4, 0.4, size=(number, 3)))
    return make_rays(origins, torch.tensor(directions), 0.0, 9.0)


def test_faces_of_two_bodies_that_almost_coincide_are_met_together(tmp_path: Path) -> None:
    """The gap is smaller than the offset of the search, and refraction lengthens the way through it."""
    rays = _upward_rays(4000, steepness=1)
    exits = [
        Snell("mesh")(rays, _stacked_boxes(tmp_path, gap, (1.6, 1.05))).exit_directions for gap in (0.0, 5e-7, 2e-6)
    ]
    for other in exits[1:]:
        torch.testing.assert_close(other, exits[0])


@pytest.mark.parametrize("branches", ["none", "all"])
@pytest.mark.parametrize("gap", [-3e-6, -1e-6, -1e-7, 1e-6, 5e-5])
@pytest.mark.parametrize("iors", [(1.33, 1.5), (1.05, 1.6), (1.6, 1.05)])
def test_bodies_that_almost_touch_are_as_bodies_in_contact(
    iors: tuple[float, float], gap: float, branches: Literal["none", "all"], tmp_path: Path
) -> None:
    """Refraction shortens or lengthens the way between their faces, and light may be totally reflected there."""
    rays, weights, exits = _upward_rays(2000, steepness=0.5), [], []
    for distance in (0.0, gap):
        trace = Snell("mesh", branches=branches).trace(rays, _stacked_boxes(tmp_path, distance, iors))
        path = trace.path
        last = (path.s < path.s[:, -1:]).sum(1) - 1
        assert path.record is not None
        assert (path.record.body.take_along_dim(last[:, None], 1)[:, 0][~trace.exceeded] == 0).all(), "ends in air"
        exits.append(path.main_polyline(path.exit_directions))
        weights.append(torch.zeros(len(rays)).index_add(0, path.ray, path.throughput.float().mean(-1)))
    differs = (exits[1] - exits[0]).norm(dim=-1) > 1e-3
    assert differs.float().mean() < 1e-3  # rays through an edge
    torch.testing.assert_close(weights[1], weights[0])


@pytest.mark.parametrize("branches", ["none", "all"])
def test_interpolated_normals_keep_light_on_its_side(branches: Literal["none", "all"], tmp_path: Path) -> None:
    """Refracted light leaves behind the plane of its triangle, reflected light before it, even if triangles are few."""
    trimesh.creation.icosphere(1).export(tmp_path / "ball.ply")
    medium = make_bodies(str(tmp_path / "ball.ply"), 1.5, resolution=16, cache=False)
    assert medium.meshes[0].facets is None, "smooth"
    rays = random_rays(10_000, 1.2, seed=0, far=9).to(torch.float32)
    trace = Snell("mesh", branches=branches, max_events=12).trace(rays, medium)
    path = trace.path
    assert path.record is not None
    planes = medium.triangles.areas(path.record.triangle.clamp(min=0)[:, 1:].long()).float()
    before, after = ((d * planes).sum(-1).sign() for d in (path.directions[:, :-1], path.directions[:, 1:]))
    is_event = path.record.triangle[:, 1:] >= 0
    is_reflected = path.record.body[:, :-1] == path.record.body[:, 1:]
    assert (before == torch.where(is_reflected, -after, after))[is_event].all()
    last = (path.s < path.s[:, -1:]).sum(1) - 1
    assert (path.record.body.take_along_dim(last[:, None], 1)[:, 0][~trace.exceeded] == 0).all(), "ends in air"


def test_gap_is_closed_between_the_bodies_beside_it_only(tmp_path: Path) -> None:
    """Neither a small body far away nor a slit in one body changes which gaps are closed."""
    slit = 1e-4
    file = {}
    for name, sides, centre in (
        ("lower", (1, 1, 1), (0, 0, -0.5)),
        ("upper", (1, 1, 1), (0, 0, 0.5 + slit)),
        ("small", (0.02, 0.02, 0.02), (3, 0, 0)),
    ):
        file[name] = tmp_path / f"{name}.ply"
        trimesh.creation.box(sides, trimesh.transformations.translation_matrix(centre)).export(file[name])
    file["both"] = tmp_path / "both.ply"
    trimesh.util.concatenate([trimesh.load(file[name]) for name in ("lower", "upper")]).export(file["both"])
    ray = make_rays(torch.tensor([[0.1, 0.2, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]), 0.0, 9.0)
    for names, expected in ((("lower", "upper", "small"), [0, 1, 2, 0]), (("both", "small"), [0, 1, 0, 1, 0])):
        bodies = {name: {"mesh": str(file[name]), "ior": 1.5 + 0.1 * i} for i, name in enumerate(names)}
        path = Snell("mesh")(ray, make_bodies(bodies=bodies, resolution=32, cache=False))
        assert path.record.body[0, : len(expected)].tolist() == expected


@pytest.mark.parametrize("x", [20.0, 20.5, 21.0, 21.0 + 1e-9])
def test_line_along_a_face_leaves_its_blocks_at_their_other_end(x: float) -> None:
    # The last of 21 blocks along x: its face is at 21, where a position may lie by rounding.
    lengths = math.inf, math.inf, 2.0
    assert end_of_blocks(20, 3, 3, 1, x, 3.5, 3.5, *lengths) == pytest.approx(1.0)
    assert end_of_blocks(20, 3, 3, 2, x, 3.5, 3.5, *lengths) == pytest.approx(3.0)


def test_blocks_end_at_the_nearest_side() -> None:
    assert end_of_blocks(2, 2, 2, 1, 2.5, 2.25, 2.5, 1.0, -1.0, 10.0) == pytest.approx(0.25)
