"""`nerfro.bend`: gradients against finite differences, meshes that are not in files; warnings of thin walls."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import nerfro
from nerfro.media.body_settings import make_bodies
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from tests.conftest import Runner, refused

Arguments = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def lens() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3).apply_transform(np.diag([1, 1, 0.5, 1]))


def block() -> trimesh.Trimesh:
    """A block without parallel faces; of equal bounds of several vertices, the box around it has no derivative."""
    mesh = trimesh.creation.box((1.0, 1.2, 0.8))
    mesh.vertices += np.random.default_rng(0).normal(0, 0.05, mesh.vertices.shape)
    return mesh


def rays(num: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    targets = 0.8 * (torch.rand(num, 3, generator=generator, dtype=torch.float64) - 0.5)
    origins = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator, dtype=torch.float64), dim=-1) * 3
    return origins, 2 * (targets - origins)


def arguments(mesh: trimesh.Trimesh, num: int) -> Arguments:
    return (torch.tensor(mesh.vertices), torch.tensor(mesh.faces), torch.tensor(1.5, dtype=torch.float64), *rays(num))


@pytest.mark.parametrize(
    ("shape", "shading"),
    [(lens, "smooth"), (block, "flat")],
    ids=["lens", "block"],
)
@pytest.mark.parametrize("argument", [0, 2, 3, 4], ids=["vertices", "ior", "origins", "directions"])
def test_gradients_are_finite_differences(shape: Callable[[], trimesh.Trimesh], shading: str, argument: int) -> None:
    """Of all results of rays that keep their triangles, along a random direction of one argument."""
    values, generator = list(arguments(shape(), 40)), torch.Generator().manual_seed(2)
    towards = torch.randn(values[argument].shape, generator=generator, dtype=torch.float64)
    step = 1e-6

    def traced(shift: Tensor | float) -> tuple[Tensor, Tensor]:
        moved = [value + shift * towards if i == argument else value for i, value in enumerate(values)]
        bent = nerfro.bend(*moved, shading=shading)
        return torch.cat([bent.positions, bent.directions, bent.lengths[:, None]], -1), bent.hit

    (before, _), (after, hit) = traced(-step), traced(step)
    expected = (after - before) / (2 * step)
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    result, _ = traced(shift)
    rows = torch.randn(result.shape, generator=generator, dtype=torch.float64)
    columns = [torch.autograd.grad((result * rows)[ray].sum(), shift, retain_graph=True)[0] for ray in range(40)]
    error = (torch.stack(columns) - (expected * rows).sum(-1)).abs() / (1 + expected.abs().sum(-1))
    assert hit.sum() > 30
    # A ray whose triangles change within the step has no derivative.
    assert (error < 1e-4).float().mean() > 0.9


def test_gradients_where_interpolated_normals_would_turn_rays_to_the_wrong_side() -> None:
    """Near the outline of a ball of few triangles, where the normals of the triangles replace interpolated ones."""
    generator, num, step = torch.Generator().manual_seed(0), 2000, 1e-6
    ball = trimesh.creation.icosphere(1)
    starts, aside, towards, rows = torch.randn(4, num, 3, generator=generator, dtype=torch.float64)
    starts = 3 * torch.nn.functional.normalize(starts, dim=-1)
    aside = torch.nn.functional.normalize(torch.linalg.cross(starts, aside), dim=-1)

    def exits(origins: Tensor) -> Tensor:
        vertices, faces = torch.tensor(ball.vertices), torch.tensor(ball.faces)
        return nerfro.bend(vertices, faces, 1.5, origins, 0.93 * aside - starts, shading="smooth").directions

    expected = (exits(starts + step * towards) - exits(starts - step * towards)) / (2 * step)
    origins = starts.clone().requires_grad_()
    (gradients,) = torch.autograd.grad((exits(origins) * rows).sum(), origins)
    error = ((gradients * towards).sum(-1) - (expected * rows).sum(-1)).abs() / (1 + expected.abs().sum(-1))
    # A ray whose triangles change within the step has no derivative.
    assert (error < 1e-4).float().mean() > 0.999


def test_meshes_in_memory_are_traced_as_files(tmp_path: Path) -> None:
    mesh = lens()
    mesh.export(tmp_path / "lens.ply")
    vertices, faces, ior, *some = arguments(mesh, 50)
    file = nerfro.bend(tmp_path / "lens.ply", 1.5, *some)
    for other in (nerfro.bend(mesh, 1.5, *some), nerfro.bend(vertices, faces, ior, *some),
                  nerfro.bend(mesh.vertices.view(np.ndarray), mesh.faces.view(np.ndarray), 1.5, *some)):  # fmt: skip
        assert torch.equal(other.hit, file.hit)
        torch.testing.assert_close(other.directions.double(), file.directions.double(), atol=2e-5, rtol=0)
    inwards = nerfro.bend(vertices, faces.flip(1), ior, *some)
    torch.testing.assert_close(inwards.directions, nerfro.bend(vertices, faces, ior, *some).directions)


def test_index_of_a_file_has_a_gradient(tmp_path: Path) -> None:
    lens().export(tmp_path / "lens.ply")
    ior = torch.tensor(1.5, requires_grad=True)
    (slope,) = torch.autograd.grad(nerfro.bend(tmp_path / "lens.ply", ior, *rays(20)).directions[:, 0].sum(), ior)
    values = [
        nerfro.bend(tmp_path / "lens.ply", 1.5 + step, *rays(20)).directions[:, 0].sum() for step in (-1e-3, 1e-3)
    ]
    assert float(slope) == pytest.approx(float(values[1] - values[0]) / 2e-3, rel=1e-2)


def test_open_and_repeated_triangles_are_refused() -> None:
    vertices, faces, *others = arguments(lens(), 2)
    refused("is not watertight", nerfro.bend, vertices, faces[1:], *others)
    refused("repeats vertices", nerfro.bend, torch.cat([vertices, vertices[:1]]), faces, *others)


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
    done = run_here(
        "train",
        *tiny_default_run,
        f"medium.mesh={mesh}",
        "sampler.path.interface=sdf",
        "trainer.max_steps=1",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
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
