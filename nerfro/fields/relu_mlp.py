"""A narrow ReLU MLP on the CPU with a hand-written gradient; the reference is a `torch.nn.Sequential`.

A layer of 64 units performs few operations per number, so that memory bandwidth limits the speed. Therefore neither
gradients nor activations are copied: ReLU and its gradient work in place, and only inputs that learn get gradients.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

# Rows of a product. oneDNN compiles and caches a program for each shape. Batches differ in the number of points, so
# each step would add 5 MB of programs. Rows of zeros therefore pad the number of points to a multiple of _STEP.
_BLOCK, _STEP = 16384, 2048


def relu_mlp(
    inputs: Float[Tensor, "P I"] | list[Float[Tensor, "P _"]], weights: list[Tensor], dtype: torch.dtype
) -> Float[Tensor, "P O"]:
    """Apply linear layers without biases, with ReLU between the layers.

    Args:
        inputs: one or several inputs, which are concatenated.
        weights: matrix [outputs, inputs] of each layer.
        dtype: number format of the matrix products.
    """
    parts = [inputs] if isinstance(inputs, Tensor) else inputs
    with torch.autocast("cpu", enabled=False):
        return _ReluMLP.apply(dtype, len(parts), *parts, *weights)


class _ReluMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, num_parts: int, *tensors: Tensor) -> Float[Tensor, "P O"]:
        parts, weights = tensors[:num_parts], tensors[num_parts:]
        layers = [weight.to(dtype) for weight in weights]
        num_points, learns = len(parts[0]), any(ctx.needs_input_grad)
        num_rows = -(-num_points // _STEP) * _STEP
        # Without gradients, all blocks share the memory of one block, which stays in the CPU's cache.
        kept = num_rows if learns else min(num_rows, _BLOCK)
        activations = [parts[0].new_zeros(kept, sum(part.shape[1] for part in parts), dtype=dtype)]
        activations += [parts[0].new_empty(kept, len(layer), dtype=dtype) for layer in layers[:-1]]
        result = parts[0].new_empty(num_rows, len(layers[-1]), dtype=dtype)
        for first in range(0, num_rows, _BLOCK):
            of_block = result[first : first + _BLOCK]
            joined, *hidden = (a.narrow(0, first if learns else 0, len(of_block)) for a in activations)
            start, size = 0, min(num_points - first, _BLOCK)
            for part in parts:
                joined[:size, start : start + part.shape[1]] = part[first : first + size]
                start += part.shape[1]
            for rows, layer, product in zip([joined, *hidden], layers, [*hidden, of_block], strict=True):
                torch.mm(rows, layer.t(), out=product)
                if product is not of_block:
                    _comparable(product).relu_()
        if learns:
            ctx.save_for_backward(*activations, *layers)
        ctx.parts, ctx.weight_dtype = [(part.shape[1], part.dtype) for part in parts], weights[0].dtype
        return result[:num_points]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "P O"]) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        activations, layers = ctx.saved_tensors[:num_layers], ctx.saved_tensors[num_layers:]
        of_weights: list[Tensor | None] = []
        num_points = len(gradient)
        gradient = F.pad(gradient, (0, 0, 0, len(activations[0]) - num_points))
        wanted = ctx.needs_input_grad[2:]
        for i in reversed(range(num_layers)):
            learns = wanted[len(ctx.parts) + i]
            of_weights.append(_product_of_columns(gradient, activations[i]).to(ctx.weight_dtype) if learns else None)
            if i > 0:
                gradient = _product(gradient, layers[i])
                bits = _comparable(gradient)
                torch.ops.aten.threshold_backward.grad_input(bits, _comparable(activations[i]), 0, grad_input=bits)
        of_parts: list[Tensor | None] = []
        start = 0
        for i, (width, dtype) in enumerate(ctx.parts):
            columns = layers[0][:, start : start + width]
            of_parts.append(_product(gradient, columns)[:num_points].to(dtype) if wanted[i] else None)
            start += width
        return None, None, *of_parts, *reversed(of_weights)


def _comparable(values: Tensor) -> Tensor:
    """View values as numbers of the same sign that the CPU compares fast.

    PyTorch widens bfloat16 for comparisons, at six times the cost. The bits as an integer have the same sign.
    """
    return values.view(torch.int16) if values.dtype == torch.bfloat16 else values


def _product(rows: Float[Tensor, "Q I"], matrix: Float[Tensor, "I O"]) -> Float[Tensor, "Q O"]:
    """Return rows @ matrix, computed in blocks."""
    product = rows.new_empty(len(rows), matrix.shape[1])
    for block, of_block in zip(rows.split(_BLOCK), product.split(_BLOCK), strict=True):
        torch.mm(block, matrix, out=of_block)
    return product


def _product_of_columns(left: Float[Tensor, "Q O"], right: Float[Tensor, "Q I"]) -> Float[Tensor, "O I"]:
    """Return left^T @ right, computed in blocks with the narrower matrix on the left, which is faster."""
    if left.shape[1] > right.shape[1]:
        return _product_of_columns(right, left).t()
    total = left.new_zeros(left.shape[1], right.shape[1], dtype=torch.promote_types(left.dtype, torch.float32))
    for ours, theirs in zip(left.split(_BLOCK), right.split(_BLOCK), strict=True):
        total += ours.t() @ theirs
    return total
