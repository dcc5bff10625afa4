"""A narrow ReLU MLP on the CPU with its gradient written out; a `torch.nn.Sequential` is its reference.

A layer of 64 units computes little for each number that it moves, so that memory decides its speed. Here no gradient
and no activation is copied: ReLU and its gradient are taken in place, and only the inputs that learn get a gradient.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def relu_mlp(
    inputs: Float[Tensor, "P I"] | list[Float[Tensor, "P _"]], weights: list[Tensor], dtype: torch.dtype
) -> Float[Tensor, "P O"]:
    """Linear layers without biases, with ReLU between them.

    Args:
        inputs: one row for each point; or several tensors, whose columns are taken side by side.
        weights: [outputs, inputs] of each layer.
        dtype: of the products, the activations and the result.
    """
    parts = [inputs] if isinstance(inputs, Tensor) else inputs
    with torch.autocast("cpu", enabled=False):
        return _ReluMLP.apply(dtype, len(parts), *parts, *weights)


class _ReluMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, num_parts: int, *tensors: Tensor) -> Float[Tensor, "P O"]:
        parts, weights = tensors[:num_parts], tensors[num_parts:]
        layers = [weight.to(dtype) for weight in weights]
        joined = torch.cat([part.to(dtype) for part in parts], dim=-1) if num_parts > 1 else parts[0].to(dtype)
        activations = [joined]
        for layer in layers[:-1]:
            hidden = activations[-1] @ layer.t()
            _comparable(hidden).relu_()
            activations.append(hidden)
        ctx.save_for_backward(*activations, *layers)
        ctx.parts, ctx.weight_dtype = [(part.shape[1], part.dtype) for part in parts], weights[0].dtype
        return activations[-1] @ layers[-1].t()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P O"]) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        activations, layers = ctx.saved_tensors[:num_layers], ctx.saved_tensors[num_layers:]
        of_weights: list[Tensor | None] = []
        wanted = ctx.needs_input_grad[2:]
        for i in reversed(range(num_layers)):
            learns = wanted[len(ctx.parts) + i]
            of_weights.append(_product_of_columns(gradient, activations[i]).to(ctx.weight_dtype) if learns else None)
            if i > 0:
                gradient = gradient @ layers[i]
                bits = _comparable(gradient)
                torch.ops.aten.threshold_backward.grad_input(bits, _comparable(activations[i]), 0, grad_input=bits)
        of_parts: list[Tensor | None] = []
        start = 0
        for i, (width, dtype) in enumerate(ctx.parts):
            of_parts.append((gradient @ layers[0][:, start : start + width]).to(dtype) if wanted[i] else None)
            start += width
        return None, None, *of_parts, *reversed(of_weights)


def _comparable(values: Tensor) -> Tensor:
    """The same memory as numbers with the same signs that the CPU compares fast.

    PyTorch widens bfloat16 to compare it, at six times the cost. As an integer it is positive where the number is.
    """
    return values.view(torch.int16) if values.dtype == torch.bfloat16 else values


def _product_of_columns(left: Float[Tensor, "P O"], right: Float[Tensor, "P I"]) -> Float[Tensor, "O I"]:
    """left^T right, with the narrower one on the left: so the matrix library is faster."""
    return left.t() @ right if left.shape[1] < right.shape[1] else (right.t() @ left).t()
