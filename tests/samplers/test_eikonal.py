"""Adaptive Eikonal paths against closed-form optics, and the plain reference of the compiled kernels."""

import math

import pytest
import torch

from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.paper.eikonal import Eikonal, euler, march_adaptive, march_uniform
from nerfro.paper.voxel_grid import VoxelGrid
from tests.closed_forms import (
    Ball,
    Luneburg,
    RoundedBox,
    Slab,
    angle,
    ball_exits,
    beam,
    grid_points,
    make_rays,
    random_rays,
    sampled,
)

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


# --- adaptive steps ---


def test_adaptive_luneburg_lens_focuses_on_its_rim() -> None:
    heights = torch.linspace(-0.9, 0.9, 13, dtype=torch.float64)
    path = Eikonal(tolerance=1e-6)(beam(heights, far=6), Luneburg().double())
    assert path.refracted.all()
    # Behind the focus rays go straight: their line passes through (R, 0, 0).
    to_focus = torch.tensor([1.0, 0, 0], dtype=torch.float64) - path.end_positions
    distance = torch.linalg.cross(to_focus, path.exit_directions).norm(dim=-1)
    assert distance.max() < 1e-4


def test_adaptive_steps_refract_exactly_at_a_flat_shell() -> None:
    angles = torch.linspace(0, 80, 9, dtype=torch.float64).deg2rad()
    directions = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    slab = Slab(0.5, 1.5, shell=0.001).double()
    path = Eikonal()(make_rays(-2 * directions, directions, 0, 8), slab)
    # Exit parallel to entry, shifted by h sin(i) (1 - cos(i) / sqrt(n^2 - sin^2 i)).
    torch.testing.assert_close(path.exit_directions, directions, atol=1e-12, rtol=0)
    shift = 0.5 * angles.sin() * (1 - angles.cos() / (1.5**2 - angles.sin() ** 2).sqrt())
    moved = torch.linalg.cross(path.end_positions, directions).norm(dim=-1)
    torch.testing.assert_close(moved, shift, atol=1e-3, rtol=0)


def test_adaptive_ball_obeys_snell_as_its_shell_thins() -> None:
    radius, n = 0.8, 1.5
    b = torch.linspace(0, 0.9, 40, dtype=torch.float64) * radius
    rays = beam(b, far=6)
    exact = ball_exits(rays, radius, n)

    def error(shell: float) -> float:
        path = Eikonal()(rays, Ball(radius, n, shell).double())
        assert path.s.shape[1] <= 10
        return float(angle(path.exit_directions, exact).max())

    assert error(0.001) < 0.1
    # What remains is the shell's width.
    assert error(0.002) / error(0.001) == pytest.approx(2.0, rel=0.15)


def test_shell_reflects_totally() -> None:
    # A ray that enters a face of the cube obliquely meets the next face beyond the critical angle.
    cube = RoundedBox(0.75, 0.08, 1.52, shell=0.001).double()
    tilt = math.radians(40)
    rays = make_rays(
        [[-3 * math.cos(tilt) - 0.75, -3 * math.sin(tilt) + 0.3, 0]], [[math.cos(tilt), math.sin(tilt), 0]], 0, 9
    )
    path = Eikonal()(rays, cube)
    torch.testing.assert_close(
        path.exit_directions, rays.directions * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_tolerance_bounds_the_distance_to_the_tangents() -> None:
    medium = Luneburg().double()
    rays = make_rays([[-3, 0.7, 0.1]], [[1, 0, 0]], 0.5, 6)
    fine = Eikonal(tolerance=1e-9)(rays, medium)
    s = torch.linspace(0.5, 6, 500, dtype=torch.float64)[None]
    for tolerance in (1e-3, 1e-4):
        path = Eikonal(tolerance=tolerance)(rays, medium)
        assert path.s.shape[1] < fine.s.shape[1] / 4
        gap = (path.at(s)[0] - fine.at(s)[0]).norm(dim=-1).max()
        # A step may overshoot the tolerance, for it is tested after the step.
        assert gap < 2.5 * tolerance * 2 * math.sqrt(3)


def test_rays_continue_straight_after_the_limit_of_steps() -> None:
    rays, medium = make_rays([[-3, 0.5, 0]], [[1, 0, 0]], 0.5, 6), Luneburg().double()
    limited, whole = (march_adaptive(rays, medium, 1e-4, max_steps) for max_steps in (50, 16384))
    assert limited.far[0] == 6
    assert angle(limited.exit_directions, whole.exit_directions) > 1


# --- compiled kernels against plain torch ---


def _grids() -> tuple[VoxelGrid, Bodies]:
    points = grid_points(1.5, 40)
    radius = points.norm(dim=-1)
    voxels = VoxelGrid.from_occupancy((radius < 0.8).float(), BOX, 1.5, 5, 1.0)
    return voxels, sampled(torch.stack([radius - 0.9, radius - 0.4]), BOX, [1.5, 1.2], 0.02)


def test_compiled_uniform_steps_match_the_reference() -> None:
    voxels, _ = _grids()
    rays = random_rays(40, 1.4, seed=1, far=7)
    compiled = Eikonal("euler", 96)(rays, voxels)
    plain = march_uniform(rays, voxels.double(), euler, 96)
    for name in ("positions", "directions", "s", "exit_directions"):
        torch.testing.assert_close(getattr(compiled, name), getattr(plain, name), atol=1e-6, rtol=0)
    assert (compiled.refracted == plain.refracted).all()
    assert compiled.refracted.any()


@pytest.mark.parametrize("kind", ["voxels", "solid"])
def test_compiled_adaptive_steps_match_the_reference(kind: str) -> None:
    voxels, solid = _grids()
    medium: Medium = voxels if kind == "voxels" else solid
    rays = random_rays(200, 1.4, seed=1, far=7)
    compiled = Eikonal()(rays, medium)
    plain = march_adaptive(rays, medium.double(), 2e-4 * 3 * math.sqrt(3), 16384)
    assert (compiled.refracted == plain.refracted).all()
    error = angle(compiled.exit_directions, plain.exit_directions)
    assert error.median() < 1e-5
    assert error.quantile(0.98) < 1e-3


def test_paths_of_different_capacity_agree() -> None:
    # A fine tolerance makes rows longer than the kernel's first guess.
    voxels, _ = _grids()
    rays = random_rays(200, 1.4, seed=1, far=7)
    path = Eikonal(tolerance=1e-6)(rays, voxels)
    assert path.s.shape[1] > 24
    single = [Eikonal(tolerance=1e-6)(rays[i : i + 1], voxels) for i in range(0, 200, 40)]
    for i, alone in zip(range(0, 200, 40), single, strict=True):
        torch.testing.assert_close(path.positions[i, : alone.s.shape[1]], alone.positions[0])
        assert (path.s[i].diff() >= 0).all()
        torch.testing.assert_close(path.far[i], alone.far[0])
