"""The MLP with its gradient written out, against torch.nn.Sequential."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from nerfro.fields.relu_mlp import relu_mlp


def layers(*widths: int) -> nn.Sequential:
    linear = [nn.Linear(a, b, bias=False) for a, b in pairwise(widths)]
    return nn.Sequential(*[part for layer in linear for part in (layer, nn.ReLU())][:-1])


def weights(mlp: nn.Sequential) -> list[Tensor]:
    return [part.weight for part in mlp if isinstance(part, nn.Linear)]


@pytest.mark.parametrize("widths", [(5, 3), (24, 64, 16), (32, 64, 64, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_equals_a_sequential_forward_and_backward(widths: tuple[int, ...], dtype: torch.dtype) -> None:
    mlp = layers(*widths)
    inputs = torch.randn(300, widths[0], requires_grad=True)
    upstream = torch.randn(300, widths[-1]).to(dtype)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        expected = mlp(inputs)
    result = relu_mlp(inputs, weights(mlp), dtype)
    assert result.dtype == dtype
    torch.testing.assert_close(result, expected)
    for mine, theirs in zip(
        torch.autograd.grad(result, [inputs, *weights(mlp)], upstream),
        torch.autograd.grad(expected, [inputs, *weights(mlp)], upstream),
        strict=True,
    ):
        assert mine.dtype == theirs.dtype
        torch.testing.assert_close(mine, theirs, rtol=1e-2 if dtype == torch.bfloat16 else 1e-5, atol=1e-5)


def test_inputs_side_by_side_of_which_one_learns() -> None:
    mlp = layers(9, 8, 3)
    first, second = torch.randn(20, 5, requires_grad=True), torch.randn(20, 4)
    result = relu_mlp([first, second], weights(mlp), torch.float32)
    expected = mlp(torch.cat([first, second], dim=-1))
    torch.testing.assert_close(result, expected)
    (mine,), (theirs,) = (torch.autograd.grad(x.square().sum(), first) for x in (result, expected))
    torch.testing.assert_close(mine, theirs)


def test_points_of_several_blocks_equal_a_sequential() -> None:
    mlp = layers(6, 8, 3)
    inputs = torch.randn(2 * 16384 + 700, 6, requires_grad=True)
    result, expected = relu_mlp(inputs, weights(mlp), torch.float32), mlp(inputs)
    torch.testing.assert_close(result, expected)
    for mine, theirs in zip(
        *(torch.autograd.grad(x.sin().sum(), [inputs, *weights(mlp)]) for x in (result, expected)), strict=True
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)


class _Products(TorchDispatchMode):
    """Collects the shapes of matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: set[tuple[torch.Size, torch.Size]] = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.overloadpacket is torch.ops.aten.mm:
            self.shapes.add((args[0].shape, args[1].shape))
        return function(*args, **kwargs or {})


def test_ever_different_numbers_of_points_make_few_shapes_of_products() -> None:
    """oneDNN keeps a program for each: 5 MB a step were left behind."""
    mlp, generator = layers(4, 8, 3), torch.Generator().manual_seed(0)
    with _Products() as products:
        for count in torch.randint(1, 50000, (40,), generator=generator).tolist():
            relu_mlp(torch.randn(count, 4, requires_grad=True), weights(mlp), torch.float32).sum().backward()
    assert len(products.shapes) <= 6 * 8  # two products forward and four backward, of eight numbers of rows each
