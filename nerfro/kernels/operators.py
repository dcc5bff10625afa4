"""Kernels as operators of PyTorch.

The device of the tensors selects the implementation of an operator: a compiled kernel on the CPU, PyTorch on other
devices. `torch.compile`, fake tensors and the profiler see operators, but not the code of kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Function = TypeVar("Function", bound=Callable)
_LIBRARY = torch.library.Library("nerfro", "FRAGMENT")
REFERENCES: dict[str, Callable[..., Any]] = {}  # implementation in PyTorch of each operator with gradients, by name


def operator(schema: str, reference: Callable[..., Any], on_cpu: Callable[..., Any]) -> Callable[..., Any]:
    """Define an operator with gradients.

    Args:
        schema: name, arguments and results in the notation of PyTorch, `name(Tensor x, int n) -> Tensor`.
        reference: differentiable implementation in PyTorch, for all devices but the CPU.
        on_cpu: differentiable implementation by operators without gradients.
    """
    name = _define(schema)
    REFERENCES[name] = reference
    _LIBRARY.impl(name, reference, "CompositeImplicitAutograd")
    for key in ("CPU", "AutogradCPU"):
        _LIBRARY.impl(name, on_cpu, key)
    return getattr(torch.ops.nerfro, name).default


def select(tensor: torch.Tensor, on_cpu: Function, reference: Function) -> Function:
    """Select the implementation of a function of objects that hold a tensor by its device; see `operator`."""
    return on_cpu if tensor.device.type == "cpu" else reference


def kernel_with_gradients(
    schema: str, result: Callable[..., Tensor], fill: Callable[..., None], gradients: Mapping[int, Callable[..., None]]
) -> Callable[..., Tensor]:
    """Define operators for a function and its gradients, each by a function that fills a NumPy array.

    Args:
        schema: name and arguments, `name(Tensor x, int n)`; tensors precede other arguments.
        result: function of the arguments, as tensors, that creates the result without its values.
        fill: function of the arguments and the result; tensors and lists are NumPy arrays.
        gradients: function for the gradient of an argument, by the number of the argument. It takes the arguments, the
            gradient of the result, and zeros of the shape of the argument, to which it adds the gradient.

    Returns:
        Differentiable function of CPU tensors.
    """
    name, _, names = schema.rstrip(")").partition("(")
    num_tensors = names.count("Tensor ")
    forward = _filled(f"{name}_forward({names}) -> Tensor", result, fill)
    backward = {
        number: _filled(f"{name}_gradient_{number}({names}, Tensor gradient) -> Tensor", _zeros_like(number), function)
        for number, function in gradients.items()
    }

    class Kernel(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, *arguments: Any) -> Tensor:
            ctx.save_for_backward(*arguments[:num_tensors])
            ctx.others = arguments[num_tensors:]
            return forward(*arguments)

        @staticmethod
        @once_differentiable
        def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
            gradients: list[Tensor | None] = [None] * len(ctx.needs_input_grad)
            for number, function in backward.items():
                if ctx.needs_input_grad[number]:
                    gradients[number] = function(*ctx.saved_tensors, *ctx.others, gradient)
            return tuple(gradients)

    return Kernel.apply


def _zeros_like(number: int) -> Callable[..., Tensor]:
    return lambda *arguments: arguments[number].new_zeros(arguments[number].shape)


def _filled(schema: str, result: Callable[..., Tensor], fill: Callable[..., None]) -> Callable[..., Tensor]:
    def run(*arguments: Any) -> Tensor:
        values = result(*arguments)
        converted = [
            value.detach().contiguous().numpy() if isinstance(value, Tensor)
            else np.array(value) if isinstance(value, list) else value
            for value in arguments
        ]  # fmt: skip
        fill(*converted, values.numpy())
        return values

    return cpu_operator(schema, result)(run)


def cpu_operator(schema: str, fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Define an operator without gradients by a function of CPU tensors.

    Args:
        schema: name, arguments and results, see `operator`.
        fake: function of the arguments that creates results of the right shapes and types without values.
    """

    def define(function: Callable[..., Any]) -> Callable[..., Any]:
        name = _define(schema)
        _LIBRARY.impl(name, function, "CPU")
        torch.library.register_fake(f"nerfro::{name}", fake, lib=_LIBRARY)
        return getattr(torch.ops.nerfro, name).default

    return define


def _define(schema: str) -> str:
    _LIBRARY.define(schema, tags=(torch.Tag.pt2_compliant_tag,))
    return schema.partition("(")[0]


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Return tensors on any device as NumPy arrays without gradients; contiguous ones on the CPU share memory."""
    return [tensor.detach().cpu().contiguous().numpy() for tensor in tensors]
