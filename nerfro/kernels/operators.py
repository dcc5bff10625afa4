"""Kernels as operators of PyTorch.

The device of the tensors selects the implementation of an operator: a compiled kernel on the CPU, PyTorch on other
devices. `torch.compile`, fake tensors and the profiler see operators, but not the code of kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch

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


def kernel(schema: str, fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Define an operator without gradients by a function that takes and returns NumPy arrays.

    Args:
        schema: name, arguments and results, see `operator`.
        fake: function of the arguments, as tensors, that creates results of the right shapes and types without values.
    """

    def define(function: Callable[..., Any]) -> Callable[..., Any]:
        def on_tensors(*arguments: Any) -> Any:
            results = function(*[
                values.detach().contiguous().numpy() if isinstance(values, torch.Tensor) else values
                for values in arguments
            ])  # fmt: skip
            return torch.from_numpy(results) if isinstance(results, np.ndarray) else (*map(torch.from_numpy, results),)

        return cpu_operator(schema, fake)(on_tensors)

    return define


def cpu_operator(schema: str, fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Define an operator without gradients by a function of CPU tensors; the arguments are those of `kernel`."""

    def define(function: Callable[..., Any]) -> Callable[..., Any]:
        name = _define(schema)
        _LIBRARY.impl(name, function, "CPU")
        torch.library.register_fake(f"nerfro::{name}", fake, lib=_LIBRARY)
        return getattr(torch.ops.nerfro, name).default

    return define


def _define(schema: str) -> str:
    _LIBRARY.define(schema, tags=(torch.Tag.pt2_compliant_tag,))
    return schema.partition("(")[0]
