"""Invariants of paths: |v| = n, moments, reversibility, phase-space volume, straight rays for n = 1, and their ends."""

import functools
from pathlib import Path as FilePath

import pytest
import torch
import trimesh
from torch import Tensor

from nerfro.core.compositing import composite
from nerfro.core.types import FieldValues, Path, Rays, Rendering
from nerfro.geometry.interpolation import intersect_box
from nerfro.media.base import Medium, Vacuum
from nerfro.media.body_settings import make_bodies
from nerfro.paper.eikonal import Eikonal, RayState, kick_drift_kick, leapfrog
from nerfro.paper.hierarchical import Hierarchical
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.base import PathSampler, PointSampler, Straight
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import example_rays
from tests.closed_forms import (
    Ball,
    FunctionMedium,
    RoundedBox,
    Squared,
    blurred_ball,
    fibre,
    fisheye,
    grid_points,
    luneburg,
    random_rays,
    sampled,
)
from tests.reference_tracer import Snell

SMOOTH = [luneburg, fisheye, fibre]


def _launch(num: int = 5) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    x = 0.6 * (torch.rand(num, 3, generator=generator, dtype=torch.float64) - 0.5)
    d = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator, dtype=torch.float64), dim=-1)
    return x, d


def _steps(x: Tensor, v: Tensor, medium: Medium, dsigma: float, num_steps: int) -> tuple[Tensor, Tensor]:
    state = RayState(x, v, *medium(x))
    for _ in range(num_steps):
        state = kick_drift_kick(state, torch.full_like(x[:, 0], dsigma), medium)
    return state.positions, state.velocities


# --- steps of fixed dsigma, the core of the leapfrog ---


@pytest.mark.parametrize("squared", SMOOTH)
def test_steps_of_fixed_dsigma_are_reversible(squared: Squared) -> None:
    medium = FunctionMedium(squared)
    x0, d = _launch()
    v0 = d * medium(x0)[0][:, None]
    x, v = _steps(x0, v0, medium, 0.004, 256)
    assert (x - x0).norm(dim=-1).min() > 0.2
    x, v = _steps(x, -v, medium, 0.004, 256)
    torch.testing.assert_close(x, x0, atol=1e-12, rtol=0)
    torch.testing.assert_close(-v, v0, atol=1e-12, rtol=0)


@pytest.mark.parametrize("squared", SMOOTH)
def test_steps_of_fixed_dsigma_keep_the_phase_space_volume(squared: Squared) -> None:
    medium = FunctionMedium(squared)
    x0, d = _launch(1)
    v0 = d * medium(x0)[0][:, None]

    def flow(phase: Tensor) -> Tensor:
        return torch.cat(_steps(phase[None, :3], phase[None, 3:], medium, 0.05, 20), -1)[0]

    jacobian = torch.autograd.functional.jacobian(flow, torch.cat([x0, v0], -1)[0])
    # Etendue: far from the identity, and yet of determinant 1. Symplectic maps also keep the form J.
    assert (jacobian - torch.eye(6)).abs().max() > 0.3
    assert float(torch.linalg.det(jacobian)) == pytest.approx(1.0, abs=1e-12)
    form = torch.zeros(6, 6, dtype=torch.float64)
    form[:3, 3:], form[3:, :3] = torch.eye(3), -torch.eye(3)
    torch.testing.assert_close(jacobian.T @ form @ jacobian, form, atol=1e-12, rtol=0)


# --- whole paths ---


@pytest.mark.parametrize("squared", [luneburg, fisheye, blurred_ball(1.52, 0.05)])
def test_speed_equals_the_index_and_radial_media_conserve_the_moment(squared: Squared) -> None:
    medium = FunctionMedium(squared)
    x0, d = torch.tensor([[-1.2, 0.6, 0.1]], dtype=torch.float64), torch.tensor([[1.0, 0.1, 0.0]]).double()
    d = torch.nn.functional.normalize(d, dim=-1)
    n, g = medium(x0)
    state = RayState(x0, n[:, None] * d, n, g)
    moment = torch.linalg.cross(x0, state.velocities)
    ds = torch.full((1,), 2.4 / 256, dtype=torch.float64)
    for _ in range(256):
        state = leapfrog(state, ds, medium)
        assert float(state.velocities.norm() / state.n - 1) == pytest.approx(0, abs=1e-4)
        # v is n times the direction: n r sin(phi), by Bouguer.
        now = torch.linalg.cross(state.positions, state.velocities)
        torch.testing.assert_close(now, moment, atol=1e-4, rtol=0)


# --- where n = 1 ---


def _of_index_one() -> dict[str, tuple[PathSampler, Medium]]:
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    radius = grid_points(1.5, 40).norm(dim=-1)
    distances = sampled(radius[None] - 0.8, box, [1.0], 0.02)
    voxels = VoxelGrid.from_occupancy((radius < 0.8).float(), box, 1.0, 5, 1.0)
    return {
        "snell-vacuum": (Snell(), Vacuum()),
        "snell-ball": (Snell(), Ball(ior=1.0)),
        "snell-grid": (Snell(), distances),
        "eikonal-vacuum": (Eikonal(), Vacuum()),
        "eikonal-ball": (Eikonal(), Ball(ior=1.0)),
        "eikonal-grid": (Eikonal(), distances),
        "eikonal-voxels": (Eikonal(), voxels),
    }


def _levels(points: PointSampler, path: Path) -> list[Rendering]:
    """Renderings of a smooth density, level after level."""
    renderings: list[Rendering] = []
    for _ in range(points.num_levels):
        samples = points(path, renderings[-1] if renderings else None)
        density = 3 * torch.exp(-samples.positions.square().sum(-1))
        values = FieldValues(density, torch.sigmoid(samples.positions))
        renderings.append(composite(samples, values, torch.zeros(len(path.s), 3), path))
    return renderings


POINTS = pytest.mark.parametrize(
    "points", [Stratified(32), Hierarchical(16, 32)], ids=lambda points: type(points).__name__
)


@POINTS
@pytest.mark.parametrize("name", _of_index_one())
def test_index_one_gives_the_samples_of_straight_rays_bit_for_bit(name: str, points: PointSampler) -> None:
    sampler, medium = _of_index_one()[name]
    rays, points = example_rays(300), points.eval()
    plain, path = Straight()(rays, Vacuum()), sampler(rays, medium)
    for expected, found in zip(_levels(points, plain), _levels(points, path), strict=True):
        for field in ("s", "positions", "directions", "edges"):
            assert torch.equal(getattr(found.samples, field), getattr(expected.samples, field))


_rays = functools.partial(random_rays, 200, 1.2, 4)
# From the camera at distance 3 the near face of the cube is reached, its far one is not.
SHORT, LONG = 3.2, 60.0


def _medium(folder: FilePath, kind: str) -> Medium:
    if kind == "analytic":
        return RoundedBox(0.7, 0.1, 1.5)
    trimesh.creation.box(extents=[1.4, 1.4, 1.4]).export(folder / "cube.ply")
    return make_bodies(str(folder / "cube.ply"), 1.5, resolution=48, cache=False)


CASES = [
    (Snell("sdf"), "grid"), (Snell("mesh"), "grid"), (Snell(), "analytic"),
    (Eikonal(), "grid"), (Eikonal(), "analytic"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "kind"), CASES)
def test_far_does_not_cut_a_path_inside_the_object(tmp_path: FilePath, sampler: PathSampler, kind: str) -> None:
    medium = _medium(tmp_path, kind)
    short, long = sampler(_rays(far=SHORT), medium), sampler(_rays(far=LONG), medium)
    bent = long.refracted
    assert bent.sum() > 50
    torch.testing.assert_close(short.exit_directions, long.exit_directions)
    assert (short.far >= SHORT).all()
    torch.testing.assert_close(short.far[~bent], torch.full_like(short.far[~bent], SHORT))
    assert _outside(short, medium)[bent].all()
    # The end lies on the line along which the longer path goes on.
    at_short_end, _ = long.at(short.far[:, None])
    torch.testing.assert_close(at_short_end[:, 0], short.end_positions, atol=2e-5, rtol=0)


@pytest.mark.parametrize(("sampler", "kind"), [(Snell("sdf", 2), "grid"), (Snell("mesh", 2), "grid")])
def test_rays_at_the_limit_of_events_end_outside(tmp_path: FilePath, sampler: Snell, kind: str) -> None:
    medium = _medium(tmp_path, kind)
    trace = sampler.trace(_rays(far=SHORT), medium)
    assert trace.exceeded.any()
    assert _outside(trace.path, medium)[trace.path.refracted].all()


def _outside(path: Path, medium: Medium) -> Tensor:
    """Whether paths end where nothing of the medium's box lies ahead."""
    _, leave = intersect_box(medium.box, path.end_positions, path.exit_directions)
    return leave <= 0


def test_path_is_the_line_from_near_to_far_in_any_medium() -> None:
    origins = torch.randn(5, 3)
    directions = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
    near, far = torch.rand(5), 4 + torch.rand(5)
    path = Straight()(Rays(origins, directions, torch.ones(5), near, far), Ball())
    torch.testing.assert_close(path.near, near)
    torch.testing.assert_close(path.far, far)
    s = torch.linspace(0, 1, 7) * (far - near)[:, None] + near[:, None]
    positions, along = path.at(s)
    torch.testing.assert_close(positions, origins[:, None] + s[..., None] * directions[:, None])
    torch.testing.assert_close(along, directions[:, None].expand(-1, 7, -1))
    torch.testing.assert_close(path.exit_directions, directions)
    assert not path.refracted.any()
