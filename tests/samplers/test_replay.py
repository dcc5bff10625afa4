"""Refined paths: the traced values, and their first derivatives against central differences of the trace itself."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.core.types import Path, Rays
from nerfro.media.base import Medium, Vacuum
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.paper.eikonal import Eikonal, march_adaptive
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.base import PathSampler, Straight
from nerfro.samplers.paths.replay import smallest_cosine
from tests.closed_forms import Ball, RoundedBox, beam, grid_points, make_rays, random_rays
from tests.reference_tracer import Snell, trace_interfaces
from tests.samplers.nested import NestedBalls, nested_grid, nested_mesh

BOX = torch.tensor([[-1.2] * 3, [1.2] * 3], dtype=torch.float64)
_rays = functools.partial(random_rays, width=1.0, seed=0, far=4)
STEADY = 0.15


class PlainSnell(Snell):
    """Finds surfaces to the last bit; the compiled kernel stops a billionth before."""

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        return trace_interfaces(rays, medium, self.max_events)[0]


class PlainEikonal(Eikonal):
    """Takes the very steps of the replay; the compiled kernel cuts free flights otherwise."""

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        return march_adaptive(rays, medium, 1e-3, self.max_steps)


def _nested_grid(inner_ior: float = 1.0, **glass: Any) -> Bodies:
    """A ball of glass with a ball beside its middle, by default a bubble: rays are totally reflected at either."""
    return nested_grid(1.2, 33, [1.5, inner_ior], **glass)


def _cube_mesh(folder: FilePath) -> Bodies:
    trimesh.creation.box(extents=[1.1, 1.2, 1.3]).export(folder / "cube.ply")
    return make_bodies(str(folder / "cube.ply"), 1.52, resolution=24, cache=False).double()


SCENES: dict[str, tuple[PathSampler, Callable[[FilePath], Medium]]] = {
    "snell-ball": (Snell(), lambda folder: Ball(0.8, 1.5).double()),
    "snell-rounded-cube": (Snell(), lambda folder: RoundedBox(0.6, 0.15, 1.52).double()),
    "snell-nested-grid": (PlainSnell(), lambda folder: _nested_grid()),
    "snell-matched-grid": (PlainSnell(), lambda folder: _nested_grid(1.5, absorption=[1.0])),
    "snell-nested-mesh": (Snell("mesh"), nested_mesh),
    "snell-cube-mesh": (Snell("mesh"), _cube_mesh),
    "eikonal-ball": (Eikonal(), lambda folder: Ball(0.8, 1.5, 0.05).double()),
    "eikonal-nested-balls": (Eikonal(), lambda folder: NestedBalls(0.05)),
    "eikonal-nested-grid": (PlainEikonal(), lambda folder: _nested_grid()),
}


def _vertices(path: Path) -> Tensor:
    """All that a path gives downstream, the last vertex repeated: [P, everything]."""
    column = torch.arange(40).clamp(max=path.s.shape[1] - 1)
    every = (path.positions[:, column], path.directions[:, column], path.s[:, column, None])
    return torch.cat([*(values.flatten(1) for values in every), path.exit_directions], -1)


def _shifted(inputs: Sequence[str], rays: Rays, medium: Medium) -> Callable[[Tensor], Rays]:
    """Shifts inputs by a multiple of a random direction, in the rays that it returns and in the medium."""
    generator = torch.Generator().manual_seed(7)

    def random(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like)

    owners = [(owner, name) for name in inputs if name != "rays" for owner in _owners(medium, name)]
    old = [getattr(owner, name) for owner, name in owners]
    change = [
        random(values) * (0.1 if name == "coefficients" else 1) for values, (_, name) in zip(old, owners, strict=True)
    ]
    moved, turned = (random(values) if "rays" in inputs else 0.0 for values in (rays.origins, rays.directions))

    def shift(step: Tensor) -> Rays:
        for (owner, name), values, along in zip(owners, old, change, strict=True):
            setattr(owner, name, values + step * along)
        if "coefficients" in inputs:
            vars(medium.grids).pop("packed", None)  # the arrays of the kernel are made once
        directions = torch.nn.functional.normalize(rays.directions + step * turned, dim=-1)
        return replace(rays, origins=rays.origins + step * moved, directions=directions)

    return shift


def _owners(medium: Medium, name: str) -> list[Any]:
    return list(medium.materials if name == "ior" else medium.grids)


INPUTS = dict.fromkeys(SCENES, ("ior", "rays"))
INPUTS |= dict.fromkeys(["snell-nested-grid", "snell-matched-grid"], ("ior", "rays", "coefficients"))
# On a grid the cell that a ray is in says where its steps begin; now and then differences see that.
INPUTS["eikonal-nested-grid"] = ("coefficients",)


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_match_central_differences(name: str, tmp_path: FilePath) -> None:
    """In a random direction of all indices, origins, directions and grid values, so that each must be right."""
    sampler, make = SCENES[name]
    rays, medium = _rays(40), make(tmp_path)
    shift = _shifted(INPUTS[name], rays, medium)

    def traced(step: float) -> Path:
        return sampler(shift(torch.tensor(step, dtype=torch.float64)), medium)

    def refined(step: Tensor) -> Tensor:
        shifted = shift(step)
        with torch.no_grad():
            path = sampler(shifted, medium)
        return _vertices(sampler.replay(path, shifted, medium))

    _, found = torch.autograd.functional.jvp(
        refined, torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    )

    def difference(h: float) -> Tensor:
        after, before = (_vertices(traced(sign * h)) for sign in (1, -1))
        return (after - before) / (2 * h)

    # Differences are no measure where a cube's rounding begins or a step is added between their two sides.
    wide, narrow = difference(4e-6), difference(2e-6)
    expected = (4 * narrow - wide) / 3
    sound = (wide - narrow).norm(dim=-1) < 3e-7 * expected.norm(dim=-1)
    if isinstance(sampler, Snell):
        path = traced(0.0)
        assert path.refracted.all()
        sound &= smallest_cosine(path, medium) > STEADY
    error = (found - expected).norm(dim=-1) / expected.norm(dim=-1)
    assert sound.sum() > 28
    assert error[sound].max() < 1e-6


REFINED: list[tuple[PathSampler, Callable[[FilePath], Medium]]] = [
    *(SCENES[name] for name in ("snell-ball", "snell-nested-mesh", "eikonal-ball")),
    (Snell(), lambda folder: _nested_grid()),
    (Eikonal(), lambda folder: _nested_grid()),
    (Eikonal("euler", 64), lambda folder: _voxels()),
    (Snell(), lambda folder: Vacuum()),
    (Straight(), lambda folder: Vacuum()),
    (Snell(), lambda folder: Ball(0.8, 1.5, abbe=30.0)),
]


def _voxels() -> VoxelGrid:
    inside = grid_points(1.2, 33, torch.float64).norm(dim=-1) < 0.8
    return VoxelGrid.from_occupancy(inside.double(), BOX, 1.5, 5, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "make"), REFINED)
def test_replayed_values_equal_traced_values_with_finite_gradients(
    sampler: PathSampler, make: Callable[[FilePath], Medium], tmp_path: FilePath
) -> None:
    rays, medium = _rays(300).to(torch.float32), make(tmp_path).float()
    rays.origins.requires_grad_()
    path = sampler(rays, medium)
    assert not path.positions.requires_grad
    found = sampler.replay(path, rays, medium)
    for name in ("positions", "directions", "s", "exit_directions", "refracted", "ray", "record"):
        traced = getattr(path, name)
        assert getattr(found, name) is traced or torch.equal(getattr(found, name), traced)
    (gradient,) = torch.autograd.grad(found.positions.sum() + found.exit_directions.sum(), rays.origins)
    assert gradient.isfinite().all()
    assert (gradient != 0).any(-1).all()


def test_straight_paths_beside_bent_paths_have_derivatives_of_lines() -> None:
    rays = make_rays([[-3, 0.3, 0], [-3, 1.1, 0]], [[1, 0, 0], [1, 0, 0]], 0.5, 4.0)
    d = rays.directions.clone().requires_grad_()
    rays = replace(rays, directions=d)
    sampler, medium = Snell(), Ball(0.8, 1.5).double()
    path = sampler.replay(sampler(rays, medium), rays, medium)
    assert path.refracted.tolist() == [True, False]
    for vertex, s in enumerate([0.5, 4.0, 4.0, 4.0]):
        (gradient,) = torch.autograd.grad(path.positions[1, vertex, 1], d, retain_graph=True)
        assert gradient.tolist() == [[0, 0, 0], [0, s, 0]]


def test_gradients_of_polylines_are_summed_at_their_ray() -> None:
    sampler, medium, rays = Snell(), Ball(0.8, 1.5).double(), _rays(3)
    rays.origins.requires_grad_()
    path = sampler(rays, medium)
    twice = torch.tensor([0, 0, 1, 2])
    split = replace(path[twice], splits=True, ray=twice)
    (single,) = torch.autograd.grad(sampler.replay(path, rays, medium).exit_directions.sum(), rays.origins)
    (double,) = torch.autograd.grad(sampler.replay(split, rays, medium).exit_directions.sum(), rays.origins)
    torch.testing.assert_close(double, single * torch.tensor([[2.0], [1.0], [1.0]]))


def test_smallest_cosine_matches_the_angles_at_a_ball() -> None:
    # Entry and exit are alike: outside cos i with sin i = b / R, inside cos t, which is larger.
    heights = torch.tensor([0.0, 0.3, 0.7, 0.79, 0.9], dtype=torch.float64)
    medium = Ball(0.8, 1.5).double()
    cosines = smallest_cosine(Snell()(beam(heights), medium), medium)
    torch.testing.assert_close(cosines[:4], (1 - (heights[:4] / 0.8) ** 2).sqrt())
    assert cosines[4] == 1
