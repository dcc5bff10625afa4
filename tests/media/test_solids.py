"""Bodies with surfaces: distances, shells, nesting, grids made of meshes."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import trimesh

from nerfro.core.errors import NerfroError
from nerfro.media.base import Medium, Vacuum
from nerfro.media.bodies import Bodies
from nerfro.media.body_settings import make_bodies
from nerfro.media.distance_grid import SURFACE_BLOCK
from tests.closed_forms import Ball, Luneburg, RoundedBox, Slab, grid_points, sampled
from tests.conftest import refused

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


def _nested_balls(size: int = 48) -> Bodies:
    radius = grid_points(1.5, size).norm(dim=-1)
    return sampled(torch.stack([radius - 0.9, radius - 0.5]), BOX, [1.5, 1.33], 0.1)


def _half_full_ball() -> Bodies:
    """Bodies that are where all before them are: a wall of glass, air in it, water in its lower half."""
    balls = _nested_balls()
    outer, inner = (grid.distances for grid in balls.grids)
    distances = [outer, inner, torch.linspace(-1.5, 1.5, len(outer)).expand(outer.shape)]
    medium = sampled(distances, BOX, [1.5, 1.0, 1.33], 0.1)
    medium.nested = True
    return medium


MEDIA = [
    Vacuum(),
    Luneburg(),
    Ball(shell=0.3),
    RoundedBox(shell=0.05, edge_radius=0.3),
    Slab(shell=0.1),
    _nested_balls(),
    _half_full_ball(),
]


@pytest.mark.parametrize("medium", MEDIA, ids=lambda medium: type(medium).__name__)
def test_gradient_is_the_derivative_of_the_index(medium: Medium) -> None:
    medium = medium.double()
    low, high = 0.97 * medium.box
    positions = low + (high - low) * torch.rand(300, 3, dtype=torch.float64)
    # Central differences are of no use across a kink.
    smooth = (medium(positions * (1 + 1e-3))[1] != 0).any(-1) == (medium(positions * (1 - 1e-3))[1] != 0).any(-1)
    positions = positions[smooth].requires_grad_()
    n, gradient = medium(positions)
    if n.requires_grad:
        (automatic,) = torch.autograd.grad(n.sum(), positions)
        torch.testing.assert_close(gradient, automatic, rtol=1e-4, atol=1e-4)
    else:
        assert (gradient == 0).all()


def test_last_body_decides_the_index() -> None:
    medium = _nested_balls()
    n, gradient = medium(torch.tensor([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 1.2, 0.0], [0.5, 0.0, 0.0]]))
    torch.testing.assert_close(n, torch.tensor([1.33, 1.5, 1.0, 1.415]), atol=2e-3, rtol=0)
    assert (gradient[:3] == 0).all()
    # From liquid into glass the index rises outwards.
    assert gradient[3, 0] > 0.5


def test_nested_body_lies_within_the_bodies_before_it() -> None:
    medium = _half_full_ball()
    places = torch.tensor([[0.0, 0.0, -0.3], [0.0, 0.0, 0.3], [0.7, 0.0, -0.2], [0.7, 0.0, 0.0], [1.2, 0.0, -0.5]])
    n, gradient = medium(places)
    torch.testing.assert_close(n, torch.tensor([1.33, 1.0, 1.5, 1.5, 1.0]), atol=2e-3, rtol=0)
    assert (gradient == 0).all()
    assert medium.deciding_body(medium.signed_distances(places)[0] < 0).tolist() == [3, 0, 1, 1, 0]


@pytest.mark.parametrize("make", [_nested_balls, _half_full_ball])
def test_clearance_reaches_no_shell(make: Callable[[], Bodies]) -> None:
    medium = make()
    positions = torch.rand(500, 3) * 2.8 - 1.4
    clearance = medium.clearance(positions)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    _, gradient = medium(positions + 0.99 * clearance[:, None] * directions)
    assert (gradient[clearance > 0.01] == 0).all()


def test_coarse_clearance_is_a_lower_bound() -> None:
    grid = _nested_balls(43).grids[0]
    block = 4 * 3 / 42
    positions = torch.rand(2000, 3) * 3 - 1.5
    coarse = grid.coarse_clearance()[((positions + 1.5) / block).long().unbind(-1)]
    exact = (positions.norm(dim=-1) - 0.9).abs()
    assert (coarse <= exact + 1e-6).all()
    # Short by the diagonals of a block and a cell, at most.
    assert (coarse >= exact - 3**0.5 * (block + 3 / 42) - 1e-6).all()


def test_coarse_slopes_bound_all_derivatives() -> None:
    medium = _nested_balls(43)
    block = SURFACE_BLOCK * 3 / 42
    positions = torch.rand(20000, 3, dtype=torch.float64) * 3 - 1.5
    x, y, z = ((positions + 1.5) / block).long().unbind(-1)
    bounds = torch.stack([grid.coarse_slopes().double()[x, y, z] for grid in medium.grids], 1)
    gradients = medium.signed_distances(positions)[1]
    assert (bounds[..., 0] <= gradients + 1e-5).all()
    assert (gradients <= bounds[..., 1] + 1e-5).all()
    # Where the outer ball is nearly flat they are narrow.
    bounded = bounds[:, 0].isfinite().all(-1).all(-1) & ((positions.norm(dim=-1) - 0.9).abs() < 0.05)
    assert bounded.sum() > 500
    assert (bounds[bounded, 0, :, 1] - bounds[bounded, 0, :, 0]).median() < 0.9


def test_empty_blocks_contain_no_surface() -> None:
    medium = _nested_balls(43)
    block = SURFACE_BLOCK * 3 / 42
    empty = medium.grids[0].empty_blocks()
    positions = torch.rand(20000, 3, dtype=torch.float64) * 3 - 1.5
    places = ((positions + 1.5) / block).long().clamp(max=len(empty) - 1)
    signs = medium.grids[0](positions)[0] < 0
    side = empty[places.unbind(-1)].long()
    reach = side.abs()
    assert torch.equal(side[reach > 0] < 0, signs[reach > 0])
    # As far as the blocks around are empty, the body is on the same side of a place as of that block's middle.
    moved = (places + (torch.rand(20000, 3) * 2 - 1) * (reach[:, None] - 1) + torch.rand(20000, 3)) * block - 1.5
    moved = moved.round(decimals=6).clamp(-1.5, 1.5)
    rows = (reach > 0) & (((moved + 1.5) / block - (places + 0.5)).abs().amax(-1) < reach - 0.5)
    assert rows.sum() > 10000
    assert torch.equal(signs[rows], medium.grids[0](moved[rows])[0] < 0)
    # Blocks are empty but for those around the surface, and some at the border.
    near = (positions.norm(dim=-1) - 0.9).abs()
    assert (reach[near < 0.01] == 0).all()
    assert (reach[(near > 3**0.5 * (block + 2 * 3 / 42)) & (positions.abs().amax(-1) < 1.2)] > 0).all()


def test_bad_solids_are_named(tmp_path: Path) -> None:
    trimesh.creation.icosphere(2, 0.8).export(tmp_path / "ball.ply")
    mesh = str(tmp_path / "ball.ply")
    refused(r"box_min=.*box_max=", make_bodies, mesh, box_min=[-1.5] * 3, box_max=[0.7] * 3, resolution=16, cache=False)
    with pytest.raises(NerfroError, match=r"medium\.box_min and medium\.box_max belong together"):
        make_bodies(mesh, box_max=[1.5] * 3, resolution=16, cache=False)


@pytest.mark.parametrize("sides", [(2.0, 2.0, 2.0), (3.0, 1.0, 0.6)])
@pytest.mark.parametrize("resolution", [12, 33])
def test_default_box_encloses_the_object_tightly(sides: tuple[float, ...], resolution: int, tmp_path: Path) -> None:
    trimesh.creation.box(sides, trimesh.transformations.translation_matrix([5, -7, 9])).export(tmp_path / "box.ply")
    medium = make_bodies(str(tmp_path / "box.ply"), resolution=resolution, cache=False)
    spacing = (medium.box[1] - medium.box[0]) / (resolution - 1)
    assert spacing.max() < 2.01 * spacing.min()
    air = torch.stack([medium.content_box[0] - medium.box[0], medium.box[1] - medium.content_box[1]])
    assert (air > (2 if resolution == 12 else 3.9) * spacing).all()
    assert air.min() < 4.1 * spacing.max()
