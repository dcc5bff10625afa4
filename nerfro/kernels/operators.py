"""Kernels as operators of PyTorch.

The device of the tensors selects the implementation of an operator: a compiled kernel on the CPU, PyTorch on other
devices. `torch.compile`, fake tensors and the profiler see operators, but not the code of kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

_LIBRARY = torch.library.Library("nerfro", "FRAGMENT")


def operator(schema: str, reference: Callable[..., Any], on_cpu: Callable[..., Any]) -> Callable[..., Any]:
    """Define an operator with gradients.

    Args:
        schema: name, arguments and results in the notation of PyTorch, `name(Tensor x, int n) -> Tensor`.
        reference: differentiable implementation in PyTorch, for all devices but the CPU.
        on_cpu: differentiable implementation by operators of `kernel`.
    """
    name = _define(schema)
    _LIBRARY.impl(name, reference, "CompositeImplicitAutograd")
    for key in ("CPU", "AutogradCPU"):
        _LIBRARY.impl(name, on_cpu, key)
    return getattr(torch.ops.nerfro, name).default


def kernel(schema: str, fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Define an operator without gradients by a function of CPU tensors.

    Args:
        schema: name, arguments and results, see `operator`.
        fake: function of the same arguments that creates results of the right shapes and types without values.
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
