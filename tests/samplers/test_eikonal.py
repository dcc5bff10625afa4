"""Eikonal paths against closed-form optics, convergence orders, and the plain reference of the compiled kernels."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.media.analytic import Luneburg, Vacuum
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import SdfGrid
from nerfro.media.shapes import Ball, RoundedBox, Slab
from nerfro.media.voxel_grid import VoxelGrid
from nerfro.samplers.eikonal import Eikonal, march_adaptive, march_uniform
from nerfro.samplers.integrators import INTEGRATORS
from nerfro.types import Path, Rays

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


class FunctionMedium(Medium):
    """Any n^2 and its gradient, without a border."""

    def __init__(self, squared: Callable[[Tensor], tuple[Tensor, Tensor]]) -> None:
        super().__init__()
        self.squared = squared
        self.box = torch.tensor([[-100.0] * 3, [100.0] * 3], dtype=torch.float64)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        squared, gradient = self.squared(positions)
        n = squared.sqrt()
        return n, gradient / (2 * n[..., None])


def _rays(origins: list | Tensor, directions: list | Tensor, near: float, far: float) -> Rays:
    o = torch.as_tensor(origins, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.as_tensor(directions, dtype=torch.float64), dim=-1)
    ones = torch.ones(len(o), dtype=torch.float64)
    return Rays(o, d, 0 * ones, near * ones, far * ones)


def _single(rays: Rays) -> Rays:
    return Rays(*(t.float() for t in (rays.origins, rays.directions, rays.radii, rays.near, rays.far)))


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle between unit vectors in degrees, exact for small ones."""
    return torch.rad2deg(2 * torch.asin((0.5 * torch.linalg.vector_norm(a.double() - b.double(), dim=-1)).clamp(max=1)))


def _leapfrog(rays: Rays, medium: Medium, num_steps: int) -> Path:
    return march_uniform(rays, medium, INTEGRATORS["leapfrog"], num_steps)


def _luneburg(x: Tensor) -> tuple[Tensor, Tensor]:
    return 2 - x.square().sum(-1), -2 * x


def _fisheye(x: Tensor) -> tuple[Tensor, Tensor]:
    share = 1 / (1 + x.square().sum(-1))
    return 4 * share**2, -16 * x * (share**3)[..., None]


def _fibre(x: Tensor) -> tuple[Tensor, Tensor]:
    across = x * x.new_tensor([1.0, 1.0, 0.0])
    return 2.25 * (1 - 0.25 * across.square().sum(-1)), -2.25 * 0.5 * across


# --- one step of the integrators ---


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_path_is_straight_in_constant_index(integrator: str) -> None:
    medium = FunctionMedium(lambda x: (torch.full_like(x[..., 0], 2.25), torch.zeros_like(x)))
    rays = _rays(torch.randn(4, 3), torch.randn(4, 3), 0.5, 3.5)
    path = march_uniform(rays, medium, INTEGRATORS[integrator], 40)
    expected = rays.origins + 3.5 * rays.directions
    torch.testing.assert_close(path.exit_positions, expected)
    torch.testing.assert_close(path.s[:, -1], rays.far)


@pytest.mark.parametrize("integrator", ["leapfrog", "rk4"])
def test_velocity_keeps_the_length_n(integrator: str) -> None:
    medium = FunctionMedium(_luneburg)
    path = march_uniform(_rays([[-1, 0.6, 0]], [[1, 0, 0]], 0, 2), medium, INTEGRATORS[integrator], 20)
    # n r sin(phi) is conserved in a radial medium only if |v| = n.
    n, _ = medium(path.positions)
    moment = n[..., None] * torch.linalg.cross(path.positions, path.directions)
    torch.testing.assert_close(
        moment[0, :, 2], torch.full((20,), float(moment[0, 0, 2]), dtype=torch.float64), rtol=3e-3, atol=0
    )


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1.0), ("leapfrog", 2.0), ("rk4", 4.0)])
@pytest.mark.parametrize("lens", ["luneburg", "fibre"])
def test_observed_order(integrator: str, order: float, lens: str) -> None:
    # Both have closed-form positions as functions of sigma, and s(sigma) by quadrature.
    if lens == "luneburg":
        start, direction, profile = [-1.0, 0.6, 0.2], [1.0, 0.1, 0.0], _luneburg
        omega = 1.0
    else:
        start, direction, profile = [0.5, 0.2, 0.0], [0.1, 0.2, 1.0], _fibre
        omega = 1.5 * 0.5
    medium = FunctionMedium(profile)
    length = 1.6
    rays = _rays([start], [direction], 0, length)
    x0, p0 = rays.origins[0], rays.directions[0] * medium(rays.origins[:1])[0]
    free = torch.tensor([0.0, 0.0, 1.0 if lens == "fibre" else 0.0], dtype=torch.float64)

    def exact(sigma: float) -> Tensor:
        swing = x0 * math.cos(omega * sigma) + p0 / omega * math.sin(omega * sigma)
        return swing * (1 - free) + (x0 + p0 * sigma) * free

    def s_of(sigma: float) -> float:
        return quad(lambda t: float(medium(exact(t)[None])[0]), 0, sigma, epsabs=1e-13, epsrel=1e-13)[0]

    low, high = 0.0, 2 * length
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if s_of(middle) < length else (low, middle)
    target = exact(low)

    def error(num_steps: int) -> float:
        path = march_uniform(rays, medium, INTEGRATORS[integrator], num_steps + 1)
        return float((path.exit_positions[0] - target).norm())

    coarse, fine = (16, 32) if integrator == "rk4" else (128, 256)
    assert math.log2(error(coarse) / error(fine)) == pytest.approx(order, abs=0.1 if order < 4 else 0.25)


def test_leapfrog_follows_the_parabola_of_linear_n_squared_to_rounding() -> None:
    g = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    medium = FunctionMedium(lambda x: (2 + x @ g, g.expand_as(x)))
    rays = _rays([[0, 0, 0]], [[0.2, 0.9, 0.1]], 0, 3)
    path = _leapfrog(rays, medium, 12)
    p0 = rays.directions[0] * math.sqrt(2)
    # x = p0 sigma + g sigma^2 / 4: sigma from the component across g, the rest must follow.
    across = torch.linalg.cross(g, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    sigma = (path.positions[0] @ across) / (p0 @ across)
    torch.testing.assert_close(path.positions[0], sigma[:, None] * p0 + sigma[:, None] ** 2 / 4 * g, atol=1e-14, rtol=0)


def test_linear_index_gives_the_catenary() -> None:
    k = 0.5
    direction = [math.cos(-0.4), math.sin(-0.4), 0.0]

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        n = 1.5 + k * x[..., 1]
        return n**2, 2 * k * n[..., None] * x.new_tensor([0.0, 1.0, 0.0])

    path = _leapfrog(_rays([[0, 0, 0]], [direction], 0, 3.0), FunctionMedium(squared), 256)
    c = 1.5 * direction[0]
    x, y = path.positions[0, :, 0].numpy(), path.positions[0, :, 1].numpy()
    vertex = c / k * math.acosh(1.5 / c)  # where the ray turns: it descends until there
    expected = c / k * np.cosh(k * (x - vertex) / c) - 1.5 / k
    np.testing.assert_allclose(y, expected, atol=1e-5)
    assert y.min() == pytest.approx((c - 1.5) / k, abs=1e-3)


def test_reversed_path_returns_to_its_start() -> None:
    medium = FunctionMedium(_luneburg)
    out = march_uniform(_rays([[-0.9, 0.3, 0.1]], [[1, 0.2, 0]], 0, 1.5), medium, INTEGRATORS["rk4"], 400)
    back = march_uniform(_rays(out.exit_positions, -out.exit_directions, 0, 1.5), medium, INTEGRATORS["rk4"], 400)
    torch.testing.assert_close(back.exit_positions, out.positions[:, 0], atol=1e-9, rtol=0)
    torch.testing.assert_close(back.exit_directions, -out.directions[:, 0], atol=1e-9, rtol=0)


# --- continuous media, paths of equal steps ---


@pytest.mark.parametrize(("integrator", "level"), [("leapfrog", 1e-5), ("rk4", 1e-8)])
def test_fisheye_rays_are_circles_through_the_antipode(integrator: str, level: float) -> None:
    start = torch.nn.functional.normalize(torch.tensor([0.7, 0.2, -0.1], dtype=torch.float64), dim=0)
    rays = _rays(start.expand(6, 3), torch.randn(6, 3, dtype=torch.float64), 0, 1.4)
    path = march_uniform(rays, FunctionMedium(_fisheye), INTEGRATORS[integrator], 256)
    chord = -2 * start  # on r = a the image of a point is opposite to it
    for row in range(6):
        # The centre: equidistant from start and image (so across the chord), and across the starting direction.
        across = chord - (chord @ rays.directions[row]) * rays.directions[row]
        centre = start - across * (start @ chord) / (across @ chord)
        radius = (path.positions[row] - centre).norm(dim=-1)
        torch.testing.assert_close(radius, (start - centre).norm().expand(256), atol=2 * level, rtol=0)


@pytest.mark.parametrize(("integrator", "level"), [("leapfrog", 1e-5), ("rk4", 1e-8)])
def test_luneburg_path_is_an_ellipse(integrator: str, level: float) -> None:
    rays = _rays([[-0.8, 0.6, 0.0], [-0.6, 0.0, 0.8]], [[1, 0, 0], [1, 0, 0]], 0, 1.8)
    medium = FunctionMedium(_luneburg)
    path = march_uniform(rays, medium, INTEGRATORS[integrator], 256)
    for row in range(2):
        x0, p0 = rays.origins[row], rays.directions[row]  # |p0| = n = 1 on the rim
        basis = torch.stack([x0, p0], -1)
        cos_sin = torch.linalg.lstsq(basis, path.positions[row].T).solution
        torch.testing.assert_close(basis @ cos_sin, path.positions[row].T, atol=1e-12, rtol=0)
        torch.testing.assert_close(
            cos_sin.square().sum(0), torch.ones(256, dtype=torch.float64), atol=2 * level, rtol=0
        )


@pytest.mark.parametrize(("integrator", "level"), [("leapfrog", 1e-5), ("rk4", 1e-8)])
def test_meridional_ray_of_a_parabolic_fibre_is_a_cosine(integrator: str, level: float) -> None:
    path = march_uniform(_rays([[0.5, 0, 0]], [[0, 0, 1]], 0, 6), FunctionMedium(_fibre), INTEGRATORS[integrator], 256)
    rho, z = path.positions[0, :, 0], path.positions[0, :, 2]
    pz = 1.5 * math.sqrt(1 - 0.25 * 0.25)
    torch.testing.assert_close(rho, 0.5 * torch.cos(0.5 * 1.5 * z / pz), atol=6 * level, rtol=0)


def test_all_meridional_rays_of_a_sech_fibre_meet_after_a_quarter_pitch() -> None:
    alpha = 1.2

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        rho = x[..., 0].square().add(x[..., 1].square()).sqrt().clamp(min=1e-12)
        n = 1.5 / torch.cosh(alpha * rho)
        across = x * x.new_tensor([1.0, 1.0, 0.0]) / rho[..., None]
        return n**2, (-2 * alpha * n**2 * torch.tanh(alpha * rho))[..., None] * across

    heights = torch.tensor([0.1, 0.3, 0.6], dtype=torch.float64)
    origins = torch.stack([heights, 0 * heights, 0 * heights], -1)
    quarter = math.pi / (2 * alpha)
    path = _leapfrog(_rays(origins, [[0, 0, 1]] * 3, 0, 1.2 * quarter), FunctionMedium(squared), 256)
    x, z = path.positions[..., 0], path.positions[..., 2]
    expected = torch.asinh(torch.sinh(alpha * heights)[:, None] * torch.cos(alpha * z)) / alpha
    torch.testing.assert_close(x, expected, atol=1e-5 * quarter, rtol=0)


@pytest.mark.parametrize("impact", [0.5, 0.8])
def test_blurred_ball_deviates_as_its_quadrature(impact: float) -> None:
    sigma = 0.012

    def n_of(r: float) -> float:
        return 1 + 0.52 * 0.5 * math.erfc((r - 1) / (sigma * math.sqrt(2)))

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        r = x.square().sum(-1).sqrt()
        n = 1 + 0.26 * torch.erfc((r - 1) / (sigma * math.sqrt(2)))
        slope = -0.52 * torch.exp(-0.5 * ((r - 1) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        return n**2, (2 * n * slope / r)[..., None] * x

    # Bouguer: n r sin(phi) = b; deviation = 2 int b dr / (r sqrt(n^2 r^2 - b^2)) - 2 acos(b / Ro), r = rm + u^2.
    outer, turning = 1.2, impact / 1.52

    def integrand(u: float) -> float:
        r = turning + u * u
        return impact * 2 * u / (r * math.sqrt(max((n_of(r) * r) ** 2 - impact**2, 1e-300)))

    rim = math.sqrt(1 - turning)
    integral = quad(integrand, 1e-9, math.sqrt(outer - turning), points=[rim - 0.03, rim, rim + 0.03], limit=2000)[0]
    deviation = 2 * integral - 2 * math.acos(impact / outer)
    rays = _rays([[-2.0, impact, 0.0]], [[1.0, 0, 0]], 0, 4)
    path = _leapfrog(rays, FunctionMedium(squared), 768)
    measured = math.degrees(math.atan2(-float(path.exit_directions[0, 1]), float(path.exit_directions[0, 0])))
    assert measured == pytest.approx(math.degrees(deviation), abs=0.03)


# --- adaptive steps ---


def test_adaptive_luneburg_lens_focuses_on_its_rim() -> None:
    heights = torch.linspace(-0.9, 0.9, 13, dtype=torch.float64)
    origins = torch.stack([torch.full_like(heights, -3), heights, 0 * heights], -1)
    path = Eikonal(tolerance=1e-6)(_rays(origins, [[1, 0, 0]] * 13, 0.5, 6), Luneburg().double())
    assert path.refracted.all()
    # Behind the focus rays go straight: their line passes through (R, 0, 0).
    to_focus = torch.tensor([1.0, 0, 0], dtype=torch.float64) - path.exit_positions
    distance = torch.linalg.cross(to_focus, path.exit_directions).norm(dim=-1)
    assert distance.max() < 1e-4


def test_adaptive_steps_refract_exactly_at_a_flat_shell() -> None:
    angles = torch.linspace(0, 80, 9, dtype=torch.float64).deg2rad()
    directions = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    slab = Slab(0.5, 1.5, half_width=8.0, shell=0.001).double()
    path = Eikonal()(_rays(-2 * directions, directions, 0, 8), slab)
    # Exit parallel to entry, shifted by h sin(i) (1 - cos(i) / sqrt(n^2 - sin^2 i)).
    torch.testing.assert_close(path.exit_directions, directions, atol=1e-12, rtol=0)
    shift = 0.5 * angles.sin() * (1 - angles.cos() / (1.5**2 - angles.sin() ** 2).sqrt())
    moved = torch.linalg.cross(path.exit_positions, directions).norm(dim=-1)
    torch.testing.assert_close(moved, shift, atol=1e-3, rtol=0)


def test_adaptive_ball_obeys_snell_as_its_shell_thins() -> None:
    radius, n = 0.8, 1.5
    b = torch.linspace(0, 0.9, 40, dtype=torch.float64) * radius
    origins = torch.stack([torch.full_like(b, -3), b, 0 * b], -1)
    rays = _rays(origins, [[1, 0, 0]] * 40, 0.5, 6)
    deviation = 2 * (torch.asin(b / radius) - torch.asin(b / (n * radius)))
    exact = torch.stack([deviation.cos(), -deviation.sin(), 0 * b], -1)

    def error(shell: float) -> float:
        path = Eikonal()(rays, Ball(radius, n, shell).double())
        assert path.s.shape[1] <= 10
        return float(_angle(path.exit_directions, exact).max())

    assert error(0.001) < 0.1
    # What remains is the shell's width.
    assert error(0.002) / error(0.001) == pytest.approx(2.0, rel=0.15)


def test_shell_reflects_totally() -> None:
    # A ray that enters a face of the cube obliquely meets the next face beyond the critical angle.
    cube = RoundedBox(0.75, 0.08, 1.52, shell=0.001).double()
    angle = math.radians(40)
    rays = _rays(
        [[-3 * math.cos(angle) - 0.75, -3 * math.sin(angle) + 0.3, 0]], [[math.cos(angle), math.sin(angle), 0]], 0, 9
    )
    path = Eikonal()(rays, cube)
    torch.testing.assert_close(
        path.exit_directions, rays.directions * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_rays_that_miss_are_two_vertices() -> None:
    path = Eikonal()(_rays([[-3, 1.2, 0], [-3, 0, 2.0]], [[1, 0, 0], [1, 0, 0]], 0.5, 6), Ball().double())
    assert path.s.shape == (2, 2)
    assert not path.refracted.any()
    torch.testing.assert_close(path.s, torch.tensor([[0.5, 6.0]] * 2).double())


def test_vacuum_bends_nothing() -> None:
    rays = _single(_rays(torch.randn(5, 3), torch.randn(5, 3), 0.1, 3))
    path = Eikonal()(rays, Vacuum())
    torch.testing.assert_close(path.exit_directions, rays.directions)
    assert path.s.shape == (5, 2)


def test_tolerance_bounds_the_distance_to_the_tangents() -> None:
    medium = Luneburg().double()
    rays = _rays([[-3, 0.7, 0.1]], [[1, 0, 0]], 0.5, 6)
    fine = Eikonal(tolerance=1e-9)(rays, medium)
    s = torch.linspace(0.5, 6, 500, dtype=torch.float64)[None]
    for tolerance in (1e-3, 1e-4):
        path = Eikonal(tolerance=tolerance)(rays, medium)
        assert path.s.shape[1] < fine.s.shape[1] / 4
        gap = (path.at(s)[0] - fine.at(s)[0]).norm(dim=-1).max()
        # A step may overshoot the tolerance, for it is tested after the step.
        assert gap < 2.5 * tolerance * 2 * math.sqrt(3)


def test_limit_of_steps_lets_rays_go_straight_on() -> None:
    path, exceeded = march_adaptive(_rays([[-3, 0.5, 0]], [[1, 0, 0]], 0.5, 6), Luneburg().double(), 1e-4, 50)
    assert exceeded.all()
    assert path.far[0] == 6


# --- compiled kernels against plain torch ---


def _grids() -> tuple[VoxelGrid, SdfGrid]:
    axis = torch.linspace(-1.5, 1.5, 40)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    radius = points.norm(dim=-1)
    voxels = VoxelGrid.from_occupancy((radius < 0.8).float(), BOX, 1.5, 5, 1.0)
    return voxels, SdfGrid.from_distances(torch.stack([radius - 0.9, radius - 0.4]), BOX, [1.5, 1.2], 0.02)


def _bundle(num: int = 200) -> Rays:
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator, dtype=torch.float64), dim=-1)
    targets = 1.4 * torch.rand(num, 3, generator=generator, dtype=torch.float64) - 0.7
    return _rays(targets - 3.5 * directions, directions, 1.0, 7.0)


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_compiled_uniform_steps_are_those_of_torch(integrator: str) -> None:
    voxels, _ = _grids()
    rays = _bundle(40)
    compiled = Eikonal(integrator, 96)(rays, voxels)  # type: ignore[arg-type]
    plain = march_uniform(rays, voxels.double(), INTEGRATORS[integrator], 96)
    for name in ("positions", "directions", "s", "exit_directions"):
        torch.testing.assert_close(getattr(compiled, name), getattr(plain, name), atol=1e-6, rtol=0)
    assert (compiled.refracted == plain.refracted).all()
    assert compiled.refracted.any()


@pytest.mark.parametrize("kind", ["voxels", "solid"])
def test_compiled_adaptive_steps_are_those_of_torch(kind: str) -> None:
    voxels, solid = _grids()
    medium: Medium = voxels if kind == "voxels" else solid
    rays = _bundle()
    compiled = Eikonal()(rays, medium)
    plain, exceeded = march_adaptive(rays, medium.double(), 2e-4 * 3 * math.sqrt(3), 16384)
    assert not exceeded.any()
    assert (compiled.refracted == plain.refracted).all()
    angle = _angle(compiled.exit_directions, plain.exit_directions)
    assert angle.median() < 1e-5
    assert angle.quantile(0.98) < 1e-3


def test_paths_of_different_capacity_agree() -> None:
    # A fine tolerance makes rows longer than the kernel's first guess.
    voxels, _ = _grids()
    rays = _bundle()
    path = Eikonal(tolerance=1e-6)(rays, voxels)
    assert path.s.shape[1] > 24
    single = [Eikonal(tolerance=1e-6)(rays[i : i + 1], voxels) for i in range(0, 200, 40)]
    for i, alone in zip(range(0, 200, 40), single, strict=True):
        torch.testing.assert_close(path.positions[i, : alone.s.shape[1]], alone.positions[0])
        assert (path.s[i].diff() >= 0).all()
        torch.testing.assert_close(path.far[i], alone.far[0])


def test_a_camera_inside_the_glass_sees_out() -> None:
    _, solid = _grids()
    rays = _single(_rays([[0.0, 0.65, 0.0]], [[0, 1, 0]], 0.0, 4))
    path = Eikonal()(rays, solid)
    torch.testing.assert_close(path.exit_directions, rays.directions)


def test_bad_options_are_named() -> None:
    with pytest.raises(NerfroError, match="num_steps=1"):
        Eikonal("euler", 1)
    with pytest.raises(NerfroError, match="must be positive"):
        Eikonal(tolerance=0.0)
