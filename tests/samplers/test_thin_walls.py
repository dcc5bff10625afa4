"""A warning names walls that are too thin for the grid, and the resolution that it recommends is sufficient."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import nerfro
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from tests.conftest import Runner


def _hollow_ball(path: Path, wall: float, shift: float = 0.0) -> Path:
    outer, inner = (trimesh.creation.icosphere(4, radius) for radius in (1.0, 1.0 - wall))
    inner.apply_translation([0, 0, shift])
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(path)
    return path


def _exits(mesh: Path, interface: str, resolution: int = 64) -> torch.Tensor:
    x = np.linspace(0.05, 0.7, 8)
    origins = np.stack([x, 0 * x, 0 * x - 3], -1)
    return nerfro.bend(mesh, 1.5, origins, [[0.0, 0.0, 1.0]] * 8, interface, resolution).directions  # type: ignore[arg-type]


def _recommended(capsys: pytest.CaptureFixture[str]) -> int:
    found = re.search(r"of object bounds walls .* resolution of the grid to (\d+), trace", capsys.readouterr().out)
    assert found is not None
    return int(found[1])


def test_recommended_resolution_traces_a_thin_wall(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = _hollow_ball(tmp_path / "hollow.ply", 0.1)
    expected = _exits(mesh, "mesh")
    assert "warning" not in capsys.readouterr().out
    wrong = _exits(mesh, "sdf", 64)
    right = _exits(mesh, "sdf", _recommended(capsys))
    assert "warning" not in capsys.readouterr().out
    assert torch.dist(right, expected) < 0.1 * torch.dist(wrong, expected)


def test_recommended_resolution_traces_walls_of_varying_thickness(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = _hollow_ball(tmp_path / "hollow.ply", 0.15, 0.1)
    _exits(mesh, "sdf", 64)
    _exits(mesh, "sdf", _recommended(capsys))
    assert "warning" not in capsys.readouterr().out


def test_solid_with_sharp_edges_has_no_thin_walls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.cylinder(1.0, 1.5, sections=3).export(tmp_path / "prism.ply")
    _exits(tmp_path / "prism.ply", "sdf")
    assert "warning" not in capsys.readouterr().out


def test_only_walls_that_bend_rays_in_wrong_directions_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bodies = {}
    for name, wall in (("glass", 0.165), ("thin", 0.1)):
        mesh = _hollow_ball(tmp_path / f"{name}.ply", wall)
        bodies[name] = {name: {"mesh": str(mesh), "ior": 1.5}}
    trimesh.creation.icosphere(4, 0.835).export(tmp_path / "water.ply")
    bodies["glass"]["water"] = {"mesh": str(tmp_path / "water.ply"), "ior": 1.33}
    for name, is_named in (("glass", False), ("thin", True)):
        warn_of_thin_walls(Snell(), make_bodies(bodies=bodies[name], resolution=64, cache=False))
        assert ("sampler/path=snell sampler.path.interface=mesh" in capsys.readouterr().out) == is_named


def test_training_warns_of_thin_walls(tmp_path: Path, tiny_default_run: list[str], run_here: Runner) -> None:
    mesh = _hollow_ball(tmp_path / "hollow.ply", 0.05)
    done = run_here("train", *tiny_default_run, f"medium.mesh={mesh}", "trainer.max_steps=1")
    assert "bounds walls of about" in done.out


def test_thin_walls_are_not_checked_without_embree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    _exits(tmp_path / "ball.ply", "sdf", 32)
    assert "warning" not in capsys.readouterr().out


def test_resolution_follows_thin_walls_in_air(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glass = {"mesh": str(_hollow_ball(tmp_path / "hollow.ply", 0.06)), "ior": 1.5}
    trimesh.creation.icosphere(4, 0.94).export(tmp_path / "water.ply")
    water = {"mesh": str(tmp_path / "water.ply"), "ior": 1.33}
    empty = make_bodies(bodies={"glass": glass}, cache=False)
    assert "the grid of glass has" in capsys.readouterr().out
    warn_of_thin_walls(Snell(), empty)
    full = make_bodies(bodies={"glass": glass, "water": water}, cache=False)
    limited = make_bodies(bodies={"glass": glass}, cache=False, max_gigabytes=0.2)
    assert "warning" not in capsys.readouterr().out
    assert 160 < len(empty.grids[0].distances) < 200
    assert [len(grid.distances) for grid in full.grids] == [128, 128]
    assert len(limited.grids[0].distances) == 146  # 64 bytes per vertex
