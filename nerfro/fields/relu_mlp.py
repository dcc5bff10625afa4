"""A narrow ReLU MLP, on the CPU with a hand-written gradient; the reference is a `torch.nn.Sequential`.

A layer of 64 units performs few operations per number, so that memory bandwidth limits the speed. Therefore neither
gradients nor activations are copied: ReLU and its gradient work in place, and only inputs that learn get gradients.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from nerfro.kernels.available import fast_bfloat16
from nerfro.kernels.compilation import share
from nerfro.kernels.operators import cpu_operator, operator

# Rows of a product. oneDNN compiles and caches a program for each shape. Batches differ in the number of points, so
# each step would add 5 MB of programs. Rows of zeros therefore pad the number of points to a multiple of _STEP.
_BLOCK, _STEP = 8192, 2048


class ReluMLP(nn.Sequential):
    """Linear layers without biases, with Glorot-uniform weights and ReLU between the layers.

    Args:
        widths: numbers of inputs, of units of each hidden layer, and of outputs.
        precision: number format of the matrix products. None selects bfloat16 if the device has units for bfloat16,
            else float32.
    """

    def __init__(self, *widths: int, precision: Literal["bfloat16", "float32"] | None = None) -> None:
        layers: list[nn.Module] = []
        for num_inputs, num_outputs in pairwise(widths):
            linear = nn.Linear(num_inputs, num_outputs, bias=False)
            nn.init.xavier_uniform_(linear.weight)
            layers += [linear, nn.ReLU()]
        super().__init__(*layers[:-1])
        self.precision = precision

    def forward(self, *inputs: Float[Tensor, "points _"]) -> Float[Tensor, "points O"]:
        """Apply the layers to one or several inputs, which are concatenated."""
        rounds = fast_bfloat16(inputs[0].device.type) if self.precision is None else self.precision == "bfloat16"
        return relu_mlp(list(inputs), [self[i].weight for i in range(0, len(self), 2)], rounds)


def _in_torch(inputs: list[Tensor], weights: list[Tensor], rounds: bool) -> Tensor:
    with torch.autocast(inputs[0].device.type, torch.bfloat16, enabled=rounds):
        values = torch.cat([part.to(inputs[0].dtype) for part in inputs], dim=-1)
        for weight in weights[:-1]:
            values = F.relu(F.linear(values, weight))
        return F.linear(values, weights[-1])


def _on_cpu(inputs: list[Tensor], weights: list[Tensor], rounds: bool) -> Tensor:
    with torch.autocast("cpu", enabled=False):
        return _ReluMLP.apply(torch.bfloat16 if rounds else torch.float32, len(inputs), *inputs, *weights)


# Applies linear layers without biases to inputs [points, _], which are concatenated, with ReLU between the layers.
# Weights are matrices [outputs, inputs], and `rounds` selects bfloat16 for the matrix products.
relu_mlp = operator("relu_mlp(Tensor[] inputs, Tensor[] weights, bool rounds) -> Tensor", _in_torch, _on_cpu)


class _ReluMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, num_parts: int, *tensors: Tensor) -> Tensor:
        parts, weights = tensors[:num_parts], tensors[num_parts:]
        layers = [weight.to(dtype) for weight in weights]
        ctx.parts, ctx.weight_dtype = [(part.shape[1], part.dtype) for part in parts], weights[0].dtype
        result, *activations = _evaluate(parts, layers, any(ctx.needs_input_grad))
        ctx.save_for_backward(*activations, *layers)
        return result[: parts[0].shape[0]]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "points O"]) -> tuple[Tensor | None, ...]:
        num_layers = len(ctx.saved_tensors) // 2
        activations, layers = ctx.saved_tensors[:num_layers], ctx.saved_tensors[num_layers:]
        wanted, widths = ctx.needs_input_grad[2:], [width for width, _ in ctx.parts]
        parts_learn, weights_learn = wanted[: len(widths)], any(wanted[len(widths) :])
        gradients = _differentiated(gradient, activations, layers, widths, parts_learn, weights_learn, ctx.weight_dtype)
        of_parts = [
            of_part.to(dtype) if learns else None
            for of_part, (_, dtype), learns in zip(gradients, ctx.parts, parts_learn, strict=False)
        ]
        if not weights_learn:
            return None, None, *of_parts, *[None] * num_layers
        return None, None, *of_parts, *gradients[len(widths) :]


def _num_rows(parts: list[Tensor]) -> int | torch.SymInt:
    return -(-parts[0].shape[0] // _STEP) * _STEP


def _shapes(parts: list[Tensor], layers: list[Tensor], keep: bool) -> list[Tensor]:
    widths = [sum(part.shape[1] for part in parts), *(len(layer) for layer in layers[:-1])] if keep else []
    return [parts[0].new_empty(_num_rows(parts), n, dtype=layers[0].dtype) for n in (len(layers[-1]), *widths)]


@cpu_operator("relu_mlp_forward(Tensor[] parts, Tensor[] layers, bool keep) -> Tensor[]", _shapes)
def _evaluate(parts: list[Tensor], layers: list[Tensor], keep: bool) -> list[Tensor]:
    """Return the result and, with `keep`, the inputs of all layers, with rows of zeros that pad the points.

    Without `keep`, all blocks share the memory of the inputs of one block, which stays in the CPU's cache.
    """
    num_points, num_rows = len(parts[0]), _num_rows(parts)
    kept = num_rows if keep else min(num_rows, _BLOCK)
    activations = [parts[0].new_zeros(kept, sum(part.shape[1] for part in parts), dtype=layers[0].dtype)]
    activations += [parts[0].new_empty(kept, len(layer), dtype=layer.dtype) for layer in layers[:-1]]
    result = parts[0].new_empty(num_rows, len(layers[-1]), dtype=layers[-1].dtype)

    def evaluate(number: int) -> None:
        first = number * _BLOCK
        of_block = result[first : first + _BLOCK]
        joined, *hidden = (a.narrow(0, first if keep else 0, len(of_block)) for a in activations)
        start, size = 0, min(num_points - first, _BLOCK)
        for part in parts:
            joined[:size, start : start + part.shape[1]] = part[first : first + size]
            start += part.shape[1]
        for rows, layer, product in zip([joined, *hidden], layers, [*hidden, of_block], strict=True):
            torch.mm(rows, layer.t(), out=product)
            if product is not of_block:
                _comparable(product).relu_()

    num_blocks = -(-num_rows // _BLOCK)
    if keep:
        share(evaluate, num_blocks)
    else:
        for number in range(num_blocks):
            evaluate(number)
    return [result, *activations] if keep else [result]


def _shapes_of_gradients(
    gradient: Tensor, activations: list[Tensor], layers: list[Tensor], widths: list[int],
    parts_learn: list[bool], weights_learn: bool, weight_type: torch.dtype,
) -> list[Tensor]:  # fmt: skip
    of_parts = [
        gradient.new_empty(gradient.shape[0], width if learns else 0)
        for width, learns in zip(widths, parts_learn, strict=True)
    ]
    return of_parts + [torch.empty_like(layer, dtype=weight_type) for layer in layers if weights_learn]


@cpu_operator(
    "relu_mlp_backward(Tensor gradient, Tensor[] activations, Tensor[] layers, int[] widths, bool[] parts_learn, "
    "bool weights_learn, ScalarType weight_type) -> Tensor[]",
    _shapes_of_gradients,
)
def _differentiated(
    gradient: Tensor, activations: list[Tensor], layers: list[Tensor], widths: list[int],
    parts_learn: list[bool], weights_learn: bool, weight_type: torch.dtype,
) -> list[Tensor]:  # fmt: skip
    """Return the gradients of the parts, which are empty for parts that do not learn, and those of the weights."""
    num_layers, inputs, points = len(layers), layers[0].split(widths, 1), _decisive_points(gradient)
    num_rows = -(-len(points) // _STEP) * _STEP
    of_parts = [
        part.zero_() for part in _shapes_of_gradients(gradient, [], [], widths, parts_learn, False, weight_type)
    ]

    def differentiate(number: int) -> list[Tensor]:
        first = number * _BLOCK
        block_points, size = points[first : first + _BLOCK], min(num_rows - first, _BLOCK)
        padded = F.pad(block_points, (0, size - len(block_points)))
        rows = [
            values[first : first + size] if len(points) == len(gradient) else values.index_select(0, padded)
            for values in activations
        ]
        of_block = F.pad(gradient[block_points], (0, 0, 0, size - len(block_points)))
        of_weights = []
        for i in reversed(range(num_layers)):
            if weights_learn:
                of_weights.append(_product_of_columns(of_block, rows[i]).to(weight_type))
            if i > 0:
                of_block = of_block @ layers[i]
                bits = _comparable(of_block)
                torch.ops.aten.threshold_backward.grad_input(bits, _comparable(rows[i]), 0, grad_input=bits)
        for of_part, columns, learns in zip(of_parts, inputs, parts_learn, strict=True):
            if learns:
                of_part[block_points] = (of_block @ columns)[: len(block_points)].to(of_part.dtype)
        return of_weights[::-1]

    of_blocks = share(differentiate, max(1, -(-num_rows // _BLOCK)))
    return of_parts + [torch.stack(of_layer).sum(0) for of_layer in zip(*of_blocks, strict=True)]


def _decisive_points(gradient: Float[Tensor, "points O"]) -> Int[Tensor, " decisive"]:
    """Return the points whose gradients, as sums of magnitudes, are at least a thousandth of the mean.

    All others together have less than a thousandth of the gradient, below the rounding of bfloat16. They lie in empty
    space or behind opaque content, half to three quarters of the samples of a ray through glass after some hundred
    steps (docs/lab/hash_grid_on_a_cpu.md). Gradients that are not finite are decisive. The gradient of an input
    therefore depends on the other points.
    """
    size = gradient.abs().sum(1)
    points = (~(size < 1e-3 * size.mean())).nonzero()[:, 0]
    # For more points, copies of their rows cost as much as the other points save.
    return points if len(points) < 0.75 * len(size) else torch.arange(len(size))


def _comparable(values: Tensor) -> Tensor:
    """View values as numbers of the same sign that the CPU compares fast.

    PyTorch widens bfloat16 for comparisons, at six times the cost. The bits as an integer have the same sign.
    """
    return values.view(torch.int16) if values.dtype == torch.bfloat16 else values


def _product_of_columns(left: Float[Tensor, "rows O"], right: Float[Tensor, "rows I"]) -> Float[Tensor, "O I"]:
    """Return left^T @ right with the narrower matrix on the left, which is faster."""
    return left.t() @ right if left.shape[1] <= right.shape[1] else (right.t() @ left).t()
