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

from nerfro.kernels.threads import share

# Rows of a product. oneDNN compiles and caches a program for each shape. Batches differ in the number of points, so
# each step would add 5 MB of programs. Rows of zeros therefore pad the number of points to a multiple of _STEP.
_BLOCK, _STEP = 8192, 2048


def relu_mlp(
    inputs: Float[Tensor, "points I"] | list[Float[Tensor, "points _"]], weights: list[Tensor], dtype: torch.dtype
) -> Float[Tensor, "points O"]:
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
    def forward(ctx: Any, dtype: torch.dtype, num_parts: int, *tensors: Tensor) -> Float[Tensor, "points O"]:
        parts, weights = tensors[:num_parts], tensors[num_parts:]
        layers = [weight.to(dtype) for weight in weights]
        num_points, learns = len(parts[0]), any(ctx.needs_input_grad)
        num_rows = -(-num_points // _STEP) * _STEP
        # Without gradients, all blocks share the memory of one block, which stays in the CPU's cache.
        kept = num_rows if learns else min(num_rows, _BLOCK)
        activations = [parts[0].new_zeros(kept, sum(part.shape[1] for part in parts), dtype=dtype)]
        activations += [parts[0].new_empty(kept, len(layer), dtype=dtype) for layer in layers[:-1]]
        result = parts[0].new_empty(num_rows, len(layers[-1]), dtype=dtype)

        def evaluate(number: int) -> None:
            first = number * _BLOCK
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

        num_blocks = -(-num_rows // _BLOCK)
        if learns:
            share(evaluate, num_blocks)
            ctx.save_for_backward(*activations, *layers)
        else:
            for number in range(num_blocks):
                evaluate(number)
        ctx.parts, ctx.weight_dtype = [(part.shape[1], part.dtype) for part in parts], weights[0].dtype
        return result[:num_points]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "points O"]) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        activations, layers = ctx.saved_tensors[:num_layers], ctx.saved_tensors[num_layers:]
        num_points, wanted, num_blocks = len(gradient), ctx.needs_input_grad[2:], -(-len(activations[0]) // _BLOCK)
        weights_learn = any(wanted[len(ctx.parts) :])
        inputs = layers[0].split([width for width, _ in ctx.parts], 1)
        of_parts = [
            gradient.new_empty(num_points, width, dtype=dtype) if wanted[i] else None
            for i, (width, dtype) in enumerate(ctx.parts)
        ]

        def differentiate(number: int) -> list[Tensor]:
            rows = [values[number * _BLOCK : (number + 1) * _BLOCK] for values in activations]
            points = slice(number * _BLOCK, min((number + 1) * _BLOCK, num_points))
            of_block = F.pad(gradient[points], (0, 0, 0, len(rows[0]) - (points.stop - points.start)))
            of_weights = []
            for i in reversed(range(num_layers)):
                if weights_learn:
                    of_weights.append(_product_of_columns(of_block, rows[i]).to(ctx.weight_dtype))
                if i > 0:
                    of_block = of_block @ layers[i]
                    bits = _comparable(of_block)
                    torch.ops.aten.threshold_backward.grad_input(bits, _comparable(rows[i]), 0, grad_input=bits)
            for of_part, columns in zip(of_parts, inputs, strict=True):
                if of_part is not None:
                    of_part[points] = (of_block @ columns)[: points.stop - points.start]
            return of_weights[::-1]

        of_blocks = share(differentiate, max(1, num_blocks))
        if not weights_learn:
            return None, None, *of_parts, *[None] * num_layers
        return None, None, *of_parts, *(torch.stack(of_layer).sum(0) for of_layer in zip(*of_blocks, strict=True))


def _comparable(values: Tensor) -> Tensor:
    """View values as numbers of the same sign that the CPU compares fast.

    PyTorch widens bfloat16 for comparisons, at six times the cost. The bits as an integer have the same sign.
    """
    return values.view(torch.int16) if values.dtype == torch.bfloat16 else values


def _product_of_columns(left: Float[Tensor, "rows O"], right: Float[Tensor, "rows I"]) -> Float[Tensor, "O I"]:
    """Return left^T @ right with the narrower matrix on the left, which is faster."""
    return left.t() @ right if left.shape[1] <= right.shape[1] else (right.t() @ left).t()
