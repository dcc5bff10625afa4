"""A narrow ReLU MLP on the CPU with its gradient written out; a `torch.nn.Sequential` is its reference.

A layer of 64 units computes little for each number that it moves, so that memory decides its speed. Here no gradient
and no activation is copied: ReLU and its gradient are taken in place.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def relu_mlp(inputs: Float[Tensor, "P I"], weights: list[Tensor], dtype: torch.dtype) -> Float[Tensor, "P O"]:
    """Linear layers without biases, with ReLU between them.

    Args:
        inputs: one row for each point.
        weights: [outputs, inputs] of each layer.
        dtype: of the products, the activations and the result.
    """
    with torch.autocast("cpu", enabled=False):
        return _ReluMLP.apply(inputs, dtype, *weights)


class _ReluMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Float[Tensor, "P I"], dtype: torch.dtype, *weights: Tensor) -> Float[Tensor, "P O"]:
        layers = [weight.to(dtype) for weight in weights]
        activations = [inputs.to(dtype)]
        for layer in layers[:-1]:
            activations.append((activations[-1] @ layer.t()).relu_())
        ctx.save_for_backward(*activations, *layers)
        ctx.input_dtype, ctx.weight_dtype = inputs.dtype, weights[0].dtype
        return activations[-1] @ layers[-1].t()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P O"]) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        activations, layers = ctx.saved_tensors[:num_layers], ctx.saved_tensors[num_layers:]
        of_weights = []
        for i in reversed(range(num_layers)):
            of_weights.append((gradient.t() @ activations[i]).to(ctx.weight_dtype))
            if i > 0:
                gradient = gradient @ layers[i]
                torch.ops.aten.threshold_backward.grad_input(gradient, activations[i], 0, grad_input=gradient)
        of_inputs = (gradient @ layers[0]).to(ctx.input_dtype) if ctx.needs_input_grad[0] else None
        return of_inputs, None, *reversed(of_weights)
