"""Derivatives of paths: closed forms, autodiff against central differences, and an adjoint that stores no states.

The samplers themselves trace without gradients; these are properties of the plain functions they are made of.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nerfro.geometry.interpolation import quadratic_spline, spline_coefficients
from nerfro.media.voxel_grid import VoxelGrid
from nerfro.samplers.eikonal import march_uniform
from nerfro.samplers.integrators import Integrator, RayState, euler, kick_drift_kick, leapfrog
from nerfro.samplers.snell_law import refract
from tests.closed_forms import FunctionMedium, Squared, blurred_ball, make_rays

ONES = torch.ones(1, dtype=torch.float64)


def _double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# --- Snell's law ---


@pytest.mark.parametrize("impact", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("n", [1.33, 1.52])
def test_deviation_of_a_ball_has_the_derivative_of_its_closed_form(n: float, impact: float) -> None:
    index = _double(n).requires_grad_()
    x = _double(-math.sqrt(1 - impact**2), impact, 0)[None]
    inside, _ = refract(_double(1, 0, 0)[None], x, ONES, index)
    leaving = x - 2 * (x * inside).sum(-1, keepdim=True) * inside
    out, reflected = refract(inside, leaving, index, ONES)
    assert not reflected.any()
    deviation = -torch.atan2(out[0, 1], out[0, 0])
    t = math.asin(impact / n)
    assert float(deviation.detach()) == pytest.approx(2 * (math.asin(impact) - t))
    (slope,) = torch.autograd.grad(deviation, index)
    assert float(slope) == pytest.approx(2 * math.tan(t) / n, rel=1e-10)


def test_gradients_are_finite_on_crossing_the_critical_angle() -> None:
    # cos and sin of 45 degrees and n = sqrt 2: within rounding of critical, and some steps to either side.
    offsets = torch.cat(
        [-(_double(*(10.0**-k for k in range(1, 17)))), _double(0.0), 10.0 ** -torch.arange(16.0, 0, -1)]
    )
    angles = (math.pi / 4 + offsets).requires_grad_()
    index = torch.full_like(angles, math.sqrt(2)).detach().requires_grad_()
    d = torch.stack([angles.sin(), 0 * angles, angles.cos()], -1)
    normal = _double(0, 0, 1).expand_as(d)
    after, reflected = refract(d, normal, index, torch.ones_like(index))
    assert reflected.any()
    assert not reflected.all()
    for gradient in torch.autograd.grad((after * _double(0.3, 0.2, 0.5)).sum(), (angles, index)):
        assert gradient.isfinite().all()
    # Exactly there, too: r = 2 and a sine of 1/2 leave no rounding.
    exact = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    d = _double(0.5, 0, math.sqrt(0.75))[None]
    after, _ = refract(d, _double(0, 0, 1)[None], exact, ONES)
    assert torch.autograd.grad(after.sum(), exact)[0].isfinite().all()


# --- unrolled steps ---


def _of_radius(radius: Tensor) -> Squared:
    return lambda x: (2 - x.square().sum(-1) / radius**2, -2 * x / radius**2)


def _of_alpha(alpha: Tensor) -> Squared:
    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        across = x * x.new_tensor([1.0, 1.0, 0.0])
        return 2.25 * (1 - alpha**2 * across.square().sum(-1)), -2.25 * 2 * alpha**2 * across

    return squared


@pytest.mark.parametrize("integrator", [euler, leapfrog])
@pytest.mark.parametrize(
    ("profile", "value"),
    [
        (lambda ior: blurred_ball(ior, 0.05), 1.52),
        (lambda radius: blurred_ball(1.52, 0.05, radius), 1.0),
        (_of_radius, 1.3),
        (_of_alpha, 0.5),
    ],
    ids=["ball-index", "ball-radius", "luneburg", "fibre"],
)
def test_autodiff_agrees_with_central_differences(
    integrator: Integrator, profile: Callable[[Tensor], Squared], value: float
) -> None:
    rays = make_rays([[-1.1, 0.4, 0.1], [-1.1, -0.7, 0.2]], [[1, 0.1, 0.2], [1, 0, 0]], 0, 2)

    def loss(parameter: Tensor) -> Tensor:
        path = march_uniform(rays, FunctionMedium(profile(parameter)), integrator, 129)
        return (path.exit_positions * _double(0.3, 0.7, -0.4)).sum() + (path.exit_directions * _double(1, -2, 3)).sum()

    parameter = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(parameter), parameter)
    step = 1e-6
    with torch.no_grad():
        expected = (loss(parameter + step) - loss(parameter - step)) / (2 * step)
    assert abs(float(expected)) > 0.1
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=0)


def test_a_voxel_grid_gets_the_gradient_of_central_differences() -> None:
    box = _double(-1.5, -1.5, -1.5, 1.5, 1.5, 1.5).reshape(2, 3)
    axis = torch.linspace(-1.5, 1.5, 16, dtype=torch.float64)
    radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1)
    medium = VoxelGrid.from_occupancy((radius < 0.9).double(), box, 1.3, 5, 1.0)
    rays = make_rays([[-1.4, 0.3, 0.1]], [[1, 0.1, 0.05]], 0, 2.5)
    table = medium.table

    def loss(values: Tensor) -> Tensor:
        medium.table = values
        path = march_uniform(rays, medium, leapfrog, 65)
        return (path.exit_positions * _double(0.3, 0.7, -0.4)).sum() + path.exit_directions[0, 1]

    (gradient,) = torch.autograd.grad(loss(table.clone().requires_grad_()), medium.table)
    assert gradient.isfinite().all()
    for flat in gradient.abs().flatten().topk(8).indices.tolist():
        shift = torch.zeros_like(table)
        shift.view(-1)[flat] = 1e-6
        expected = (loss(table + shift) - loss(table - shift)) / 2e-6
        torch.testing.assert_close(gradient.flatten()[flat], expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("integrator", [euler, leapfrog])
def test_gradients_are_finite_where_the_index_is_constant(integrator: Integrator) -> None:
    index = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    medium = FunctionMedium(lambda x: (index.square().expand(len(x)), torch.zeros_like(x)))
    path = march_uniform(make_rays([[0, 0, 0]], [[1, 2, 2]], 0, 2), medium, integrator, 9)
    (gradient,) = torch.autograd.grad(path.exit_positions.sum() + path.exit_directions.sum(), index)
    assert float(gradient) == pytest.approx(0, abs=1e-12)  # the index of everywhere bends nothing


# --- the adjoint of steps of fixed dsigma ---


def _spline_medium(coefficients: Tensor, box: Tensor) -> FunctionMedium:
    """n^2 as a quadratic B-spline, whose second derivatives exist."""
    return FunctionMedium(lambda x: quadratic_spline(coefficients, box, x))


def _spline_weights(x: Tensor, box: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """B-spline weights of all grid vertices at one point with gradient and Hessian: [N], [N, 3], [N, 3, 3].

    Written down anew: the spline's pieces are 3/4 - t^2 for |t| < 1/2 and (3/2 - |t|)^2 / 2 for |t| < 3/2.
    """
    scale = (size - 1) / (box[1] - box[0])
    t = (x - box[0])[:, None] * scale[:, None] - torch.arange(size, dtype=x.dtype)
    near, outer = t.abs() < 0.5, (t.abs() >= 0.5) & (t.abs() < 1.5)
    rest = 1.5 - t.abs()
    value = torch.where(near, 0.75 - t * t, 0.0) + torch.where(outer, 0.5 * rest**2, 0.0)
    slope = (torch.where(near, -2 * t, 0.0) - torch.where(outer, rest * t.sign(), 0.0)) * scale[:, None]
    bend = (torch.where(near, -2.0, 0.0) + torch.where(outer, 1.0, 0.0)) * scale[:, None] ** 2
    jets = (value, slope, bend)

    def product(orders: tuple[int, int, int]) -> Tensor:
        a, b, c = (jets[order][axis] for axis, order in enumerate(orders))
        return (a[:, None, None] * b[None, :, None] * c[None, None, :]).reshape(-1)

    def counted(*axes: int) -> tuple[int, int, int]:
        return axes.count(0), axes.count(1), axes.count(2)

    gradient = torch.stack([product(counted(i)) for i in range(3)], -1)
    hessian = torch.stack([torch.stack([product(counted(i, j)) for j in range(3)], -1) for i in range(3)], -2)
    return product((0, 0, 0)), gradient, hessian


def test_adjoint_run_backwards_deposits_what_autodiff_finds() -> None:
    """With dsigma fixed, x' = p, p' = grad(n^2) / 2: mu' = -lam, lam' = -(grad grad n^2 / 2) mu, and a vertex of the
    grid receives the integral of mu . grad w / 2. States are not stored but run backwards."""
    size, dsigma, num_steps = 10, 0.02, 45
    box = _double(-1, -1, -1, 1, 1, 1).reshape(2, 3)
    axis = torch.linspace(-1, 1, size, dtype=torch.float64)
    p = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = 2 - p.square().sum(-1) + 0.2 * torch.sin(3 * p[..., 0] + 2 * p[..., 1])
    coefficients = spline_coefficients(values).requires_grad_()
    medium, h = _spline_medium(coefficients, box), torch.full((1,), dsigma, dtype=torch.float64)
    x0 = _double(-0.6, 0.2, 0.1)[None]
    v0 = (_double(0.96, 0.28, 0)[None] * medium(x0)[0][:, None]).detach()  # the start does not depend on the grid
    lam, mu = _double(0.3, 0.7, -0.4), _double(1, -2, 3)

    state = RayState(x0, v0, *medium(x0))
    for _ in range(num_steps):
        state = kick_drift_kick(state, h, medium)
    assert state.positions.abs().max() < 0.8
    loss = state.positions[0] @ lam + state.velocities[0] @ mu
    (expected,) = torch.autograd.grad(loss, coefficients)

    with torch.no_grad():
        deposit = torch.zeros(size**3, dtype=torch.float64)
        back = RayState(state.positions, -state.velocities, state.n, state.gradients)

        def kick(position: Tensor, lam: Tensor, mu: Tensor) -> Tensor:
            _, gradient, hessian = _spline_weights(position, box, size)
            deposit.add_(0.5 * (gradient @ (0.5 * dsigma * mu)))
            return lam + 0.5 * torch.einsum("v,vij,j->i", coefficients.flatten(), hessian, 0.5 * dsigma * mu)

        for _ in range(num_steps):
            lam = kick(back.positions[0], lam, mu)
            mu = mu + dsigma * lam
            back = kick_drift_kick(back, h, medium)
            lam = kick(back.positions[0], lam, mu)
    torch.testing.assert_close(back.positions, x0, atol=1e-12, rtol=0)
    torch.testing.assert_close(deposit.reshape(expected.shape), expected, atol=1e-11, rtol=0)
    assert expected.abs().max() > 0.01
