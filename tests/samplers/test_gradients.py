"""Derivatives of paths: closed forms, and autodiff against central differences.

The samplers themselves trace without gradients; these are properties of the plain functions they are made of.
"""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nerfro.paper.eikonal import Integrator, euler, leapfrog, march_uniform
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.paths.snell_law import refract
from tests.closed_forms import FunctionMedium, Squared, blurred_ball, grid_points, make_rays

ONES = torch.ones(1, dtype=torch.float64)


def _double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# --- Snell's law ---


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
        return (path.end_positions * _double(0.3, 0.7, -0.4)).sum() + (path.exit_directions * _double(1, -2, 3)).sum()

    parameter = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(parameter), parameter)
    step = 1e-6
    with torch.no_grad():
        expected = (loss(parameter + step) - loss(parameter - step)) / (2 * step)
    assert abs(float(expected)) > 0.1
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=0)


@pytest.mark.slow
def test_gradient_of_a_voxel_grid_matches_central_differences() -> None:
    box = _double(-1.5, -1.5, -1.5, 1.5, 1.5, 1.5).reshape(2, 3)
    radius = grid_points(1.5, 16, torch.float64).norm(dim=-1)
    medium = VoxelGrid.from_occupancy((radius < 0.9).double(), box, 1.3, 5, 1.0)
    rays = make_rays([[-1.4, 0.3, 0.1]], [[1, 0.1, 0.05]], 0, 2.5)
    table = medium.table

    def loss(values: Tensor) -> Tensor:
        medium.table = values
        path = march_uniform(rays, medium, leapfrog, 65)
        return (path.end_positions * _double(0.3, 0.7, -0.4)).sum() + path.exit_directions[0, 1]

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
    (gradient,) = torch.autograd.grad(path.end_positions.sum() + path.exit_directions.sum(), index)
    assert float(gradient) == pytest.approx(0, abs=1e-12)  # the index of everywhere bends nothing
