"""`python -m nerfro.trace`: its files, its options, its refusals."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import nerfro
from nerfro.media.body_settings import make_bodies
from tests.closed_forms import ball_exits, beam
from tests.conftest import UTM, Runner, moved_mesh


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_here: Runner) -> Callable[..., str]:
    """Run the entry point in this process on a glass ball; returns what it printed."""
    trimesh.creation.icosphere(4, 0.8).export(tmp_path / "ball.ply")
    monkeypatch.chdir(tmp_path)
    common = ["medium.mesh=ball.ply", "medium.resolution=64", "medium.cache=false", "rays=rays.npz", "out=out.npz"]

    def run(*overrides: str) -> str:
        done = run_here("trace", *common, *overrides, code=None)
        return done.err if done.code else done.out

    return run


def _write_rays(file: Path, place: Sequence[float] = (0, 0, 0), num: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A beam along +x that the ball covers in part; returns heights and exact exit directions for n = 1.5."""
    heights = np.linspace(-0.95, 0.95, num)
    rays = beam(torch.from_numpy(heights))
    np.savez(file, origins=rays.origins.numpy() - [1, 0, 0] + place, directions=rays.directions.numpy())
    return heights, ball_exits(rays, 0.8, 1.5).numpy()


BOX = ["medium.box_min=[-1.5,-1.5,-1.5]", "medium.box_max=[1.5,1.5,1.5]"]
SAMPLERS = [["sampler/path=snell"], ["sampler.path.interface=mesh"], ["sampler/path=eikonal"]]


@pytest.mark.parametrize("place", [(0, 0, 0), UTM], ids=["origin", "utm"])
@pytest.mark.parametrize("options", SAMPLERS, ids=["snell", "mesh", "eikonal"])
def test_exit_directions_of_a_ball_match_closed_form(
    trace: Callable[..., str], tmp_path: Path, options: list[str], place: tuple[float, ...]
) -> None:
    heights, exact = _write_rays(tmp_path / "rays.npz", place)
    moved_mesh(trimesh.load(tmp_path / "ball.ply"), place, tmp_path / "ball.obj")
    box = [
        f"medium.box_{end}=[{','.join(str(x + side) for x in place)}]" for end, side in (("min", -1.5), ("max", 1.5))
    ]
    assert "40 rays traced" in trace("medium.mesh=ball.obj", "medium.ior=1.5", *box, *options)
    with np.load(tmp_path / "out.npz") as out:
        clear = np.abs(np.abs(heights) - 0.8) > 0.01  # the eikonal shell has a width
        assert out["hit"][clear].tolist() == (np.abs(heights) < 0.8)[clear].tolist()
        error = np.degrees(np.arccos(np.clip((out["exit_directions"] * exact).sum(-1), -1, 1)))
        # The shell that eikonal sees is a tenth of these coarse voxels.
        assert np.median(error) < (0.15 if "sampler/path=eikonal" in options else 0.02)
        assert error[np.abs(heights) < 0.7].max() < 0.5
        # Where the box is left, on the line that leaves the ball.
        np.testing.assert_allclose(np.abs(out["exit_positions"][clear] - place).max(-1), 1.5, atol=1e-4)
        missed = ~out["hit"] & clear
        np.testing.assert_allclose(out["path_lengths"][missed], 5.5, atol=1e-4)
        assert (out["path_lengths"][out["hit"]] > 5.3).all()
        events = 0 if "sampler/path=eikonal" in options else 2
        assert (out["events"] == events * out["hit"])[clear].all()


@pytest.mark.slow
def test_bodies_by_name_are_those_of_the_short_form(trace: Callable[..., str], tmp_path: Path) -> None:
    _write_rays(tmp_path / "rays.npz")
    trimesh.creation.icosphere(3, 0.4).export(tmp_path / "inner.ply")
    forms = [
        ["medium.ior=1.5"],
        ["bodies={glass: {ior: 1.5}}"],
        ["bodies={glass: {ior: 1.5}, water: {mesh: inner.ply, ior: 1.33}}"],
        ["bodies={water: {mesh: inner.ply, ior: 1.33, priority: 1}, glass: {ior: 1.5}}"],
    ]
    exits = []
    for number, options in enumerate(forms):
        trace(*options, f"out={number}.npz")
        with np.load(tmp_path / f"{number}.npz") as out:
            exits.append(out["exit_directions"])
    for one, other in (exits[:2], exits[2:]):
        np.testing.assert_array_equal(one, other)
        assert np.abs(one[:, 1]).max() > 0.1
    assert np.abs(exits[0] - exits[2]).max() > 0.1


def test_far_ends_straight_paths_and_bent_ones_outside_the_box(trace: Callable[..., str], tmp_path: Path) -> None:
    _write_rays(tmp_path / "rays.npz")
    trace("sampler/path=eikonal", "near=2", "far=6", *BOX)
    with np.load(tmp_path / "out.npz") as out:
        np.testing.assert_allclose(out["path_lengths"][~out["hit"]], 6, atol=1e-5)
        lengths, ends = out["path_lengths"][out["hit"]], out["exit_positions"][out["hit"]]
        assert ((np.abs(lengths - 6) < 1e-5) | (np.abs(ends).max(-1) > 1.5)).all()
        assert lengths.min() > 6 - 1e-5
        assert (np.abs(ends).max(-1) > 1.5).all()


def test_tracing_of_the_paper_is_an_option(trace: Callable[..., str], tmp_path: Path) -> None:
    _, exact = _write_rays(tmp_path / "rays.npz")
    paper = ["medium=voxel_grid", "medium.smoothing_size=3", "sampler/path=eikonal", "sampler.path.integrator=euler"]
    trace(*paper, "near=2", "far=6")
    with np.load(tmp_path / "out.npz") as out:
        error = np.degrees(np.arccos(np.clip((out["exit_directions"] * exact).sum(-1), -1, 1)))
        assert 0.05 < np.median(error) < 5


def test_plot_is_written_beside_the_result(trace: Callable[..., str], tmp_path: Path) -> None:
    _write_rays(tmp_path / "rays.npz")
    assert "drew 24" in trace("plot=true")
    from PIL import Image

    picture = np.asarray(Image.open(tmp_path / "out.png").convert("RGB")).astype(int)
    red = (picture[..., 0] > 150) & (picture[..., 1] < 100)
    blue = (picture[..., 2] > picture[..., 0] + 40) & ~red
    assert 0.002 < red.mean() < 0.2
    assert 0.05 < blue.mean() < 0.5


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"origins": np.zeros((2, 3))}, "no array 'directions'"),
        ({"origins": np.zeros((2, 3)), "directions": np.zeros((3, 2))}, "must be [R, 3]"),
        ({"origins": np.zeros((2, 3)), "directions": np.full((2, 3), np.nan)}, "directions=nan is not allowed"),
        ({"origins": np.full((2, 3), 1e39), "directions": np.zeros((2, 3))}, "origins=1e+39 is not allowed"),
        ({"origins": np.zeros((2, 3), complex), "directions": np.eye(3)[:2]}, "complex128; they must be real numbers"),
        ({"origins": np.zeros((2, 3), bool), "directions": np.eye(3)[:2]}, "bool; they must be real numbers"),
        ({"origins": np.full((2, 3), "x"), "directions": np.eye(3)[:2]}, "<U1; they must be real numbers"),
        ({"origins": np.zeros((2, 3)), "directions": np.ones((2, 3))}, "make them 1"),
        ({"origins": np.zeros((2, 3)), "directions": np.eye(3)}, "one for each ray"),
        ({"origins": np.zeros((0, 3)), "directions": np.zeros((0, 3))}, "not empty"),
    ],
)
def test_bad_rays_give_a_one_line_error(trace: Callable[..., str], tmp_path: Path, arrays: dict, message: str) -> None:
    np.savez(tmp_path / "rays.npz", **arrays)
    printed = trace()
    assert message in printed
    assert len(printed.strip().splitlines()) == 1
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["medium.mesh=none.ply"], "none.ply does not exist"),
        (["out=result.txt"], "must end in .npz"),
        (["near=5", "far=2"], "near=5.0, far=2.0 is no range"),
        (["medium=voxel_grid", "medium.smoothing_size=3"], "medium=sdf_grid"),
        (["medium=voxel_grid", "bodies={a: {ior: 1.5}}"], "bodies is not a setting"),
    ],
)
def test_bad_options_give_a_one_line_error(
    trace: Callable[..., str], tmp_path: Path, options: list[str], message: str
) -> None:
    _write_rays(tmp_path / "rays.npz")
    assert message in trace(*options)


@pytest.mark.parametrize("name", ["out.npz", "out.png"])
def test_existing_results_are_replaced_only_on_request(trace: Callable[..., str], tmp_path: Path, name: str) -> None:
    _write_rays(tmp_path / "rays.npz")
    (tmp_path / name).write_text("precious")
    assert f"{name} exists; give another out=... or overwrite=true" in trace("plot=true")
    assert (tmp_path / name).read_text() == "precious"
    assert "40 rays traced" in trace("plot=true", "overwrite=true")
    assert (tmp_path / name).read_bytes() != b"precious"


def test_every_path_of_a_ray_that_splits_is_written(trace: Callable[..., str], tmp_path: Path) -> None:
    heights, exact = _write_rays(tmp_path / "rays.npz")
    assert "40 rays traced on " in trace("medium.ior=1.5", "sampler.path.branches=all", "plot=true")
    with np.load(tmp_path / "out.npz") as out:
        rows = out["ray"]
        assert len(rows) == len(out["exit_directions"]) > 60
        weights = np.bincount(rows, out["throughput"][:, 0])
        np.testing.assert_allclose(weights, 1, atol=1e-5)
        main = np.flatnonzero(np.diff(rows, prepend=-1))
        inner = np.abs(heights) < 0.7
        np.testing.assert_allclose(out["exit_directions"][main][inner], exact[inner], atol=1e-2)
        # The last path of a ray is the reflection at its first surface.
        mirrored = out["exit_directions"][np.append(main[1:], len(rows)) - 1]
        normal = np.stack([-np.sqrt(0.64 - heights[inner] ** 2), heights[inner], 0 * heights[inner]], -1) / 0.8
        expected = np.array([1.0, 0, 0]) - 2 * normal[:, :1] * normal
        np.testing.assert_allclose(mirrored[inner], expected, atol=2e-2)
    assert (tmp_path / "out.png").exists()


def test_polylines_meet_the_triangles(tmp_path: Path) -> None:
    shape = trimesh.creation.icosahedron()
    shape.export(tmp_path / "body.ply")
    medium = make_bodies(str(tmp_path / "body.ply"), 1.5, resolution=16, cache=False, shading="flat")
    (path,) = nerfro.polylines(medium, [[0.1, 0.2, -3.0]], [[0.05, 0.02, 1.0]], interface="mesh")
    heights = ((path[1:3, None] - shape.triangles[:, 0]) * shape.face_normals).sum(-1)
    np.testing.assert_allclose(heights.max(1), 0, atol=1e-5)
