"""Small tensors of numbers that are known beforehand."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a training step may save them for its gradients
def constant(values: tuple, device: torch.device, dtype: torch.dtype = torch.long) -> Tensor:
    """A tensor of (nested tuples of) numbers; kept, because a copy to a GPU at each step would stall it."""
    return torch.tensor(values, device=device, dtype=dtype)
