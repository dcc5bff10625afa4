"""Linear layers by oneDNN, against those of PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tests.paper import Linear


@pytest.mark.parametrize("batch", [(1024,), (2, 1024), (700,), (0,)])
def test_values_and_gradients_equal_a_layer_of_torch_on_concatenated_inputs(batch: tuple[int, ...]) -> None:
    layer = Linear(8, 7)
    inputs = [torch.randn(*batch, width, requires_grad=True) for width in (5, 3)]
    result, expected = layer(*inputs), nn.functional.linear(torch.cat(inputs, -1), layer.weight, layer.bias)
    torch.testing.assert_close(result, expected)
    for mine, theirs in zip(
        *(torch.autograd.grad(x.sin().sum(), [*inputs, layer.weight, layer.bias]) for x in (result, expected)),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)
