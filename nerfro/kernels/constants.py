"""Small constant tensors."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a training step may save them for its gradients
def constant(values: tuple, device: torch.device, dtype: torch.dtype = torch.long) -> Tensor:
    """Return a tensor of (nested tuples of) numbers, cached because copies to a GPU in each step would stall it."""
    return torch.tensor(values, device=device, dtype=dtype)
