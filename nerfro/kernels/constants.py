"""Small constant tensors."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


def constant(values: tuple, device: torch.device, dtype: torch.dtype = torch.long) -> Tensor:
    """Return a tensor of (nested tuples of) numbers, cached because copies to a GPU in each step would stall it."""
    # torch.compile does not see the cache.
    make = _constant if torch.compiler.is_compiling() else cached_constant
    return make(values, device, dtype)


@torch.inference_mode(False)  # a training step may save constants for its gradients
def _constant(values: tuple, device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.tensor(values, device=device, dtype=dtype)


cached_constant = lru_cache(maxsize=64)(_constant)
