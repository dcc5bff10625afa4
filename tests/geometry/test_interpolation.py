"""Interpolation on grids: exactness, order and gradient."""

import pytest
import torch

from nerfro.geometry.interpolation import intersect_box, quadratic_spline, spline_coefficients, trilinear

BOX = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 1.5, 1.0]], dtype=torch.float64)


def _grid(sizes: tuple[int, int, int]) -> torch.Tensor:
    axes = [torch.linspace(*BOX[:, axis].tolist(), n, dtype=torch.float64) for axis, n in enumerate(sizes)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


def _inner_points(num: int) -> torch.Tensor:
    return BOX[0] + (BOX[1] - BOX[0]) * (0.2 + 0.6 * torch.rand(num, 3, dtype=torch.float64))


def test_trilinear_reproduces_products_of_linear_functions() -> None:
    x, y, z = _grid((5, 6, 7)).unbind(-1)
    table = torch.stack([1 + x - 2 * y + x * y * z, z], -1)
    points = BOX[0] + (BOX[1] - BOX[0]) * torch.rand(50, 3, dtype=torch.float64)
    x, y, z = points.unbind(-1)
    torch.testing.assert_close(trilinear(table, BOX, points), torch.stack([1 + x - 2 * y + x * y * z, z], -1))


def test_trilinear_clamps_to_border_values_outside() -> None:
    table = _grid((4, 4, 4))
    outside = torch.tensor([[-3.0, 0.2, 0.5], [0.1, 9.0, 7.0]], dtype=torch.float64)
    torch.testing.assert_close(trilinear(table, BOX, outside), torch.minimum(torch.maximum(outside, BOX[0]), BOX[1]))


def test_spline_reproduces_quadratics_and_their_gradients() -> None:
    x, y, z = _grid((9, 10, 11)).unbind(-1)
    coefficients = spline_coefficients(x**2 - x * y + 3 * z**2 + y)
    points = _inner_points(50)
    x, y, z = points.unbind(-1)
    value, gradient = quadratic_spline(coefficients, BOX, points)
    torch.testing.assert_close(value, x**2 - x * y + 3 * z**2 + y)
    torch.testing.assert_close(gradient, torch.stack([2 * x - y, 1 - x, 6 * z], -1))


def test_spline_gradient_is_that_of_its_value() -> None:
    coefficients = torch.rand(6, 7, 8, dtype=torch.float64)
    points = _inner_points(40).requires_grad_()
    value, gradient = quadratic_spline(coefficients, BOX, points)
    (automatic,) = torch.autograd.grad(value.sum(), points)
    torch.testing.assert_close(gradient, automatic)


def test_spline_of_smooth_values_has_order_three() -> None:
    points = _inner_points(200)

    def error(n: int) -> float:
        coefficients = spline_coefficients(_grid((n, n, n)).sin().prod(-1))
        return float((quadratic_spline(coefficients, BOX, points)[0] - points.sin().prod(-1)).abs().max())

    order = torch.log2(torch.tensor(error(17) / error(33)))
    assert order == pytest.approx(3.0, abs=0.3)


def test_box_intersections_lie_on_its_planes() -> None:
    origins = torch.tensor([[-3.0, 0.5, 0.5], [0.0, 0.0, 0.5], [-3.0, 5.0, 0.5], [1.0, 0.0, 0.5]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    enter, leave = intersect_box(BOX, origins, directions)
    assert enter[0] == 2
    assert leave[0] == 4
    assert leave[1] == pytest.approx(0.5 / 0.8)
    assert enter[2] > leave[2]
    # A line within a face counts as inside.
    assert leave[3] == 1.5
