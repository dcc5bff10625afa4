"""Transfer of values with many tensors to another device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from itertools import accumulate
from typing import Any, TypeVar

import torch
from torch import Tensor

Value = TypeVar("Value")

_ALIGNMENT = 16  # bytes; vectorized kernels load this many at once


def transfer(value: Value, device: torch.device) -> Value:
    """Send all tensors of nested dataclasses and mappings from the CPU to a device in a single copy.

    With CUDA, the host does not wait for the copy. Tensors that are already on the device are kept. A value for the CPU
    is returned as it is.

    Args:
        value: dataclass, mapping or tensor, without gradients on the CPU.
        device: device of the result.
    """
    if device.type == "cpu":
        return value
    sent: dict[int, Tensor] = {}  # by identity, because paths share tensors with their rays

    def collect(tensor: Tensor) -> Tensor:
        if tensor.device != device:
            sent[id(tensor)] = tensor
        return tensor

    _map_tensors(value, collect)
    if not sent:
        return value
    arrived = dict(zip(sent, _send(list(sent.values()), device), strict=True))
    return _map_tensors(value, lambda tensor: arrived.get(id(tensor), tensor))


def _map_tensors(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Replace the tensors of nested dataclasses and mappings."""
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _map_tensors(entry, change) for key, entry in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value)]
        return replace(value, **{name: _map_tensors(getattr(value, name), change) for name in names})
    return value


def _send(tensors: list[Tensor], device: torch.device) -> list[Tensor]:
    """Copy tensors into one buffer, which is sent, and return their views of it."""
    # Expanded axes have a stride of zero and are sent once.
    dense = [tensor[tuple(slice(None if step else 1) for step in tensor.stride())] for tensor in tensors]
    ends = list(accumulate(-(-tensor.nbytes // _ALIGNMENT) * _ALIGNMENT for tensor in dense))
    parts = [slice(start, start + tensor.nbytes) for start, tensor in zip([0, *ends], dense, strict=False)]
    # The allocator of pinned memory does not use the buffer again before the copy ends. Other devices have none.
    on_cuda = device.type == "cuda"
    buffer = torch.empty(ends[-1], dtype=torch.uint8, pin_memory=on_cuda and torch.cuda.is_available())
    for tensor, part in zip(dense, parts, strict=True):
        buffer[part].view(tensor.dtype).view(tensor.shape).copy_(tensor)
    there = buffer.to(device, non_blocking=on_cuda)
    return [
        there[part].view(own.dtype).view(own.shape).expand(tensor.shape)
        for tensor, own, part in zip(tensors, dense, parts, strict=True)
    ]
