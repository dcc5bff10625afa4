"""Paths of equal steps through continuous media against closed forms, at the levels of docs/results/verification.md.

Positions are within 1e-5 of the scene's size in double precision and 1e-4 in single, with 256 leapfrog steps. The size
is stated in each test.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad, simpson
from torch import Tensor

from nerfro.core.types import Path, Rays
from nerfro.media.base import Medium
from nerfro.paper.eikonal import Integrator, euler, leapfrog, march_uniform
from tests.closed_forms import (
    FIBRE_ALPHA,
    FunctionMedium,
    Squared,
    blurred_ball,
    fibre,
    fisheye,
    layered,
    luneburg,
    make_rays,
)

NUM_STEPS = 256
LEVELS = pytest.mark.parametrize(("dtype", "level"), [(torch.float64, 1e-5), (torch.float32, 1e-4)])


def _trace(rays: Rays, squared: Squared, dtype: torch.dtype = torch.float64) -> Path:
    """Trace in the given precision; the vertices come back in double."""
    path = march_uniform(rays.to(dtype), FunctionMedium(squared), leapfrog, NUM_STEPS + 1)
    assert path.positions.dtype == dtype
    names = ("positions", "directions", "s", "radii")
    return dataclasses.replace(path, **{name: getattr(path, name).double() for name in names})


# --- layers: n sin(theta) is conserved ---


@pytest.mark.parametrize("width", [0.1, 0.3, 1.5])
@pytest.mark.parametrize(("before", "after"), [(1.0, 1.5), (1.5, 1.0), (1.33, 1.52)])
def test_blurred_layers_refract_like_a_plane(before: float, after: float, width: float) -> None:
    steepest = min(0.9 * math.asin(min(after / before, 1.0)), math.radians(60))
    angles = torch.linspace(0, steepest, 7, dtype=torch.float64)
    directions = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    rays = make_rays(-1.2 * directions / directions[:, 2:], directions, 0, 6)
    sine = before / after * angles.sin()
    expected = torch.stack([sine, 0 * sine, (1 - sine**2).sqrt()], -1)
    path = _trace(rays, layered(before, after, width))
    torch.testing.assert_close(path.exit_directions, expected, atol=1e-12, rtol=0)


def test_layers_reflect_totally_beyond_the_critical_angle() -> None:
    angles = torch.tensor([45.0, 60.0, 75.0], dtype=torch.float64).deg2rad()  # the critical angle is 41.8 degrees
    directions = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    path = _trace(make_rays(-2 * directions, directions, 0, 5), layered(1.5, 1.0, 0.5))
    mirrored = directions * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(path.exit_directions, mirrored, atol=1e-12, rtol=0)
    # The path turns where n has fallen to its conserved n sin(theta).
    n, _ = FunctionMedium(layered(1.5, 1.0, 0.5))(path.positions)
    torch.testing.assert_close(n.amin(-1), 1.5 * angles.sin(), atol=1e-3, rtol=0)


# --- radial media ---


@pytest.mark.parametrize("impact", [0.2, 0.5, 0.7, 0.8, 0.9])
def test_deviation_of_a_blurred_ball_matches_quadrature(impact: float) -> None:
    sigma, ior = 0.012, 1.52

    def n_of(r: float) -> float:
        return 1 + (ior - 1) * 0.5 * math.erfc((r - 1) / (sigma * math.sqrt(2)))

    # Bouguer: n r sin(phi) = b; deviation = 2 int b dr / (r sqrt(n^2 r^2 - b^2)) - 2 acos(b / Ro), r = rm + u^2.
    outer, turning = 1.2, impact / ior

    def integrand(u: float) -> float:
        r = turning + u * u
        return impact * 2 * u / (r * math.sqrt(max((n_of(r) * r) ** 2 - impact**2, 1e-300)))

    rim = math.sqrt(1 - turning)
    integral = quad(integrand, 1e-9, math.sqrt(outer - turning), points=[rim - 0.03, rim, rim + 0.03], limit=2000)[0]
    deviation = 2 * integral - 2 * math.acos(impact / outer)
    rays = make_rays([[-2.0, impact, 0.0]], [[1.0, 0, 0]], 0, 4)
    path = march_uniform(rays, FunctionMedium(blurred_ball(ior, sigma)), leapfrog, 768)
    measured = math.degrees(math.atan2(-float(path.exit_directions[0, 1]), float(path.exit_directions[0, 0])))
    assert measured == pytest.approx(math.degrees(deviation), abs=0.03)


@LEVELS
def test_luneburg_path_is_an_ellipse(dtype: torch.dtype, level: float) -> None:
    rays = make_rays([[-0.8, 0.6, 0.0], [-0.6, 0.0, 0.8]], [[1, 0, 0], [1, 0, 0]], 0, 1.8)
    path = _trace(rays, luneburg, dtype)
    for row in range(2):
        basis = torch.stack([rays.origins[row], rays.directions[row]], -1)  # |p0| = n = 1 on the rim
        cos_sin = torch.linalg.lstsq(basis, path.positions[row].T).solution
        nearest = basis @ (cos_sin / cos_sin.norm(dim=0))
        distance = (path.positions[row].T - nearest).norm(dim=0)
        assert distance.max() < 2 * level  # the lens is 2 wide


@LEVELS
def test_parallel_beam_converges_at_the_luneburg_focus(dtype: torch.dtype, level: float) -> None:
    for height in (0.2, 0.5, 0.8):
        entry = torch.tensor([-math.sqrt(1 - height**2), height, 0.0], dtype=torch.float64)
        p0 = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

        def index(sigma: float, entry: Tensor = entry, p0: Tensor = p0) -> float:
            position = entry * math.cos(sigma) + p0 * math.sin(sigma)
            return math.sqrt(2 - float(position @ position))

        length = quad(index, 0, math.pi / 2, epsabs=1e-13, epsrel=1e-13)[0]  # ds = n dsigma
        path = _trace(make_rays(entry[None], p0[None], 0, length), luneburg, dtype)
        assert (path.end_positions[0] - p0).norm() < 2 * level
        # From the plane x = -1 to the focus all optical paths are 1 + pi / 2 long.
        n, _ = FunctionMedium(luneburg)(path.positions[0])
        optical = 1 + float(entry[0]) + simpson(n.numpy(), dx=length / NUM_STEPS)
        assert optical == pytest.approx(1 + math.pi / 2, abs=2 * level)


def _fisheye_circle(start: Tensor, degrees: float) -> tuple[Tensor, Tensor, float, float]:
    """Direction, centre, radius and length up to the image of the ray at an angle to the way through the middle."""
    inward = -torch.nn.functional.normalize(start, dim=0)
    sideways = torch.linalg.cross(inward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    sideways = sideways / sideways.norm()
    turn = math.radians(degrees)
    direction = math.cos(turn) * inward + math.sin(turn) * sideways
    image = -start / (start @ start)
    # The centre is equidistant from start and image, and lies across the direction.
    middle = 0.5 * (start + image)
    centre = middle + sideways * ((start - middle) @ direction) / (sideways @ direction)
    radius = float((start - centre).norm())
    half = math.asin(float((image - start).norm()) / (2 * radius))
    return direction, centre, radius, 2 * half * radius


@LEVELS
@pytest.mark.parametrize("distance", [1.0, 0.85])
def test_fisheye_rays_are_circles_through_the_image_point(dtype: torch.dtype, level: float, distance: float) -> None:
    start = distance * torch.nn.functional.normalize(torch.tensor([0.7, 0.2, -0.1], dtype=torch.float64), dim=0)
    image = -start / (start @ start)
    size = float((image - start).norm())
    for degrees in (5, 20, 40, 60):
        direction, centre, radius, length = _fisheye_circle(start, degrees)
        assert radius**2 == pytest.approx(1 + float(centre @ centre))
        path = _trace(make_rays(start[None], direction[None], 0, length), fisheye, dtype)
        assert ((path.positions[0] - centre).norm(dim=-1) - radius).abs().max() < size * level
        to_image = image - path.end_positions[0]
        assert torch.linalg.cross(to_image, path.exit_directions[0]).norm() < size * level


# --- fibres ---


@LEVELS
def test_skew_rays_of_a_parabolic_fibre_are_ellipses(dtype: torch.dtype, level: float) -> None:
    length = 6.0
    rays = make_rays([[0.5, 0.2, 0.0], [0.3, -0.4, 0.0]], [[0.1, 0.2, 1.0], [-0.2, 0.1, 1.0]], 0, length)
    path = _trace(rays, fibre, dtype)
    omega = 1.5 * FIBRE_ALPHA
    p0 = rays.directions * FunctionMedium(fibre)(rays.origins)[0][:, None]
    sigma = path.positions[..., 2:] / p0[:, None, 2:]
    expected = rays.origins[:, None] * torch.cos(omega * sigma) + p0[:, None] / omega * torch.sin(omega * sigma)
    torch.testing.assert_close(path.positions[..., :2], expected[..., :2], atol=length * level, rtol=0)


# --- mirages ---


@pytest.mark.parametrize(("dtype", "level"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])
def test_leapfrog_follows_the_parabola_of_linear_n_squared_to_rounding(dtype: torch.dtype, level: float) -> None:
    g = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    medium = FunctionMedium(lambda x: (2 + x @ g.to(x), g.to(x).expand_as(x)))
    rays = make_rays([[0, 0, 0]], [[0.2, 0.9, 0.1]], 0, 3)
    path = march_uniform(rays.to(dtype), medium, leapfrog, 12)
    p0 = rays.directions[0] * math.sqrt(2)
    # x = p0 sigma + g sigma^2 / 4: sigma from the component across g, the rest must follow.
    across = torch.linalg.cross(g, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    positions = path.positions[0].double()
    sigma = (positions @ across) / (p0 @ across)
    torch.testing.assert_close(positions, sigma[:, None] * p0 + sigma[:, None] ** 2 / 4 * g, atol=level, rtol=0)


@LEVELS
def test_linear_index_gives_the_catenary(dtype: torch.dtype, level: float) -> None:
    k, length = 0.5, 3.0
    direction = [math.cos(-0.4), math.sin(-0.4), 0.0]

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        n = 1.5 + k * x[..., 1]
        return n**2, 2 * k * n[..., None] * x.new_tensor([0.0, 1.0, 0.0])

    path = _trace(make_rays([[0, 0, 0]], [direction], 0, length), squared, dtype)
    c = 1.5 * direction[0]
    x, y = path.positions[0, :, 0].numpy(), path.positions[0, :, 1].numpy()
    vertex = c / k * math.acosh(1.5 / c)  # where the ray turns: it descends until there
    expected = c / k * np.cosh(k * (x - vertex) / c) - 1.5 / k
    np.testing.assert_allclose(y, expected, atol=length * level)
    # Total reflection in a continuous medium: the ray turns where n = C.
    assert y.min() == pytest.approx((c - 1.5) / k, abs=1e-4)


# --- orders ---


@pytest.mark.parametrize(("integrator", "order"), [(euler, 1.0), (leapfrog, 2.0)])
@pytest.mark.parametrize("lens", ["luneburg", "fibre"])
def test_integrators_have_their_order_of_convergence(integrator: Integrator, order: float, lens: str) -> None:
    # Both have closed-form positions as functions of sigma, and s(sigma) by quadrature.
    if lens == "luneburg":
        start, direction, profile = [-1.0, 0.6, 0.2], [1.0, 0.1, 0.0], luneburg
        omega = 1.0
    else:
        start, direction, profile = [0.5, 0.2, 0.0], [0.1, 0.2, 1.0], fibre
        omega = 1.5 * FIBRE_ALPHA
    medium: Medium = FunctionMedium(profile)
    length = 1.6
    rays = make_rays([start], [direction], 0, length)
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
        path = march_uniform(rays, medium, integrator, num_steps + 1)
        return float((path.end_positions[0] - target).norm())

    assert math.log2(error(128) / error(256)) == pytest.approx(order, abs=0.1)
