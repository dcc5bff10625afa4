"""Linear layers in single precision on the CPU by oneDNN.

PyTorch multiplies float32 matrices by MKL, which uses AVX2 on processors of AMD. oneDNN uses AVX-512: 0.24 instead of
0.10 TFLOP/s on one core of Zen 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from nerfro.kernels.operators import operator

# oneDNN compiles and caches a program for each number of rows, so numbers that vary from step to step are left to MKL.
_ROWS = 512


class Linear(nn.Linear):
    """`torch.nn.Linear` with first derivatives, by `linear`."""

    def forward(self, *inputs: Float[Tensor, "*batch _"]) -> Float[Tensor, "*batch O"]:
        """Apply the layer to one or several inputs, which are concatenated."""
        return linear(self.weight, self.bias, *inputs)


def linear(
    weight: Float[Tensor, "O I"], bias: Float[Tensor, "O"], *inputs: Float[Tensor, "*batch _"]
) -> Float[Tensor, "*batch O"]:
    """Apply a linear layer to one or several inputs, which are concatenated.

    Large inputs are multiplied by oneDNN on processors with AVX-512.
    """
    return (_in_torch if torch.compiler.is_compiling() else _linear)(weight, bias, list(inputs))


def _in_torch(weight: Tensor, bias: Tensor, inputs: list[Tensor]) -> Tensor:
    first, *others = inputs
    joined = torch.cat([first, *(other.to(first.dtype) for other in others)], -1) if others else first
    return nn.functional.linear(joined, weight, bias)


def _on_cpu(weight: Tensor, bias: Tensor, inputs: list[Tensor]) -> Tensor:
    first = inputs[0]
    if not _suits_onednn(first):
        return _in_torch(weight, bias, inputs)
    result = _Linear.apply(weight, bias, *(part.reshape(-1, part.shape[-1]) for part in inputs))
    # PyTorch would copy a view before an operator in place.
    return result if first.ndim == 2 else result.view(*first.shape[:-1], len(weight))


_linear = operator("linear(Tensor weight, Tensor bias, Tensor[] inputs) -> Tensor", _in_torch, _on_cpu)


def _suits_onednn(x: Float[Tensor, "*batch I"]) -> bool:
    num_rows = math.prod(x.shape[:-1])
    return (
        x.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and num_rows > 0
        and num_rows % _ROWS == 0
        and torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability() == "AVX512"
    )


class _Linear(torch.autograd.Function):
    """Product of a weight and concatenated inputs, which are not copied."""

    @staticmethod
    def forward(
        ctx: Any, weight: Float[Tensor, "O I"], bias: Float[Tensor, "O"], *parts: Float[Tensor, "rows _"]
    ) -> Float[Tensor, "rows O"]:
        ctx.save_for_backward(weight, *parts)
        first, *others = _split(weight, parts)
        total = _product(parts[0], first, bias)
        for part, columns in zip(parts[1:], others, strict=True):
            total += _product(part, columns)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "rows O"]) -> tuple[Tensor | None, ...]:
        (weight, *parts), gradient = ctx.saved_tensors, gradient.contiguous()
        weight_learns, bias_learns, *parts_learn = ctx.needs_input_grad
        of_weight = None
        if weight_learns:
            of_weight = torch.cat([_product_of_columns(gradient, part) for part in parts], 1)
        of_parts = [
            _product(gradient, columns.t()) if learns else None
            for columns, learns in zip(_split(weight, parts), parts_learn, strict=True)
        ]
        return of_weight, gradient.sum(0) if bias_learns else None, *of_parts


def _split(weight: Float[Tensor, "O I"], parts: Sequence[Float[Tensor, "rows _"]]) -> list[Float[Tensor, "O _"]]:
    """Return the columns of a weight for each part of the inputs; oneDNN is slow if they are not contiguous."""
    return [columns.contiguous() for columns in weight.split([part.shape[1] for part in parts], 1)]


def _product_of_columns(left: Float[Tensor, "rows O"], right: Float[Tensor, "rows I"]) -> Float[Tensor, "O I"]:
    """Return left^T @ right, a sum over blocks of rows."""
    total = left.new_zeros(left.shape[1], right.shape[1])
    for rows, other_rows in zip(left.split(_ROWS), right.split(_ROWS), strict=True):
        total += _product(rows.t(), other_rows.t())
    return total


def _product(
    rows: Float[Tensor, "rows I"], weight: Float[Tensor, "O I"], bias: Float[Tensor, "O"] | None = None
) -> Float[Tensor, "rows O"]:
    """Return rows @ weight^T + bias."""
    return torch.ops.mkldnn._linear_pointwise(rows, weight, bias, "none", [], "")
