"""Gradients of `nerfro.bend` against finite differences, and meshes that are not in files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import nerfro
from tests.conftest import refused

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
