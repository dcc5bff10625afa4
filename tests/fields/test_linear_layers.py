"""Linear layers and MLPs with explicit gradients, against those of PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import pytest
import torch
from torch import Tensor, nn

from nerfro.fields.relu_mlp import relu_mlp
from nerfro.kernels import compilation
from nerfro.paper.linear import Linear
from tests.gradients import require_equal_gradients


def layers(*widths: int) -> nn.Sequential:
    linear = [nn.Linear(a, b, bias=False) for a, b in pairwise(widths)]
    return nn.Sequential(*[part for layer in linear for part in (layer, nn.ReLU())][:-1])


def weights(mlp: nn.Sequential) -> list[Tensor]:
    return [part.weight for part in mlp if isinstance(part, nn.Linear)]


@pytest.mark.parametrize("widths", [(5, 3), (24, 64, 16), (32, 64, 64, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_layers_equal_sequential_forward_and_backward(widths: tuple[int, ...], dtype: torch.dtype) -> None:
    mlp = layers(*widths)
    inputs = torch.randn(300, widths[0], requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        expected = mlp(inputs)
    result = relu_mlp([inputs], weights(mlp), dtype == torch.bfloat16)
    assert result.dtype == dtype
    torch.testing.assert_close(result, expected)
    tolerance = 1e-2 if dtype == torch.bfloat16 else 1e-5
    require_equal_gradients(result, expected, [inputs, *weights(mlp)], tolerance, atol=1e-5)


def test_concatenated_inputs_of_which_one_has_gradients() -> None:
    mlp = layers(9, 8, 3)
    first, second = torch.randn(20, 5, requires_grad=True), torch.randn(20, 4)
    result = relu_mlp([first, second], weights(mlp), False)
    expected = mlp(torch.cat([first, second], dim=-1))
    torch.testing.assert_close(result, expected)
    require_equal_gradients(result, expected, [first], atol=1e-5)


def test_blocks_equal_sequential_with_one_and_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    mlp = layers(6, 8, 3)
    inputs = torch.randn(2 * 16384 + 700, 6, requires_grad=True)

    def evaluated(model: Callable[[Tensor], Tensor]) -> list[Tensor]:
        result = model(inputs)
        return [result, *torch.autograd.grad(result.sin().sum(), [inputs, *weights(mlp)])]

    alone = evaluated(lambda x: relu_mlp([x], weights(mlp), False))
    for mine, theirs in zip(alone, evaluated(mlp), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)
    with ThreadPoolExecutor(1) as helper:
        monkeypatch.setattr(compilation, "HELPERS", [helper])
        helped = evaluated(lambda x: relu_mlp([x], weights(mlp), False))
    assert all(torch.equal(mine, theirs) for mine, theirs in zip(alone, helped, strict=True))


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_gradients_of_points_that_do_not_matter_are_left_out(share: float) -> None:
    mlp, inputs = layers(6, 8, 3), torch.randn(20_000, 6, requires_grad=True)
    gradient, tiny = torch.randn(20_000, 3), torch.rand(20_000) < share
    gradient[tiny] *= 1e-5
    learned = [inputs, *weights(mlp)]
    of_points, *of_weights = torch.autograd.grad(relu_mlp([inputs], weights(mlp), False), learned, gradient)
    expected = torch.autograd.grad(mlp(inputs), learned, gradient)
    for mine, theirs in zip(of_weights, expected[1:], strict=True):
        assert (mine - theirs).abs().sum() < 1e-3 * theirs.abs().sum()
    torch.testing.assert_close(of_points[~tiny], expected[0][~tiny])
    assert (of_points[tiny].count_nonzero() == 0) == (share == 0.9)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_gradient_that_is_not_finite_is_never_left_out(value: float) -> None:
    mlp = layers(6, 8, 3)
    gradient = torch.full((5000, 3), 1e-9)
    gradient[7, 0], gradient[8] = value, 1.0
    of_weights = torch.autograd.grad(relu_mlp([torch.randn(5000, 6)], weights(mlp), False), weights(mlp), gradient)
    assert not any(of_layer.isfinite().all() for of_layer in of_weights)


@pytest.mark.parametrize("batch", [(1024,), (2, 1024), (700,), (0,)])
def test_values_and_gradients_equal_a_layer_of_torch_on_concatenated_inputs(batch: tuple[int, ...]) -> None:
    layer = Linear(8, 7)
    inputs = [torch.randn(*batch, width, requires_grad=True) for width in (5, 3)]
    result, expected = layer(*inputs), nn.functional.linear(torch.cat(inputs, -1), layer.weight, layer.bias)
    torch.testing.assert_close(result, expected)
    require_equal_gradients(result, expected, [*inputs, layer.weight, layer.bias], 1e-4, atol=1e-4)
