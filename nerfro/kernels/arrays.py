"""Tensors as compiled kernels take them."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """The memory of tensors on the CPU, gradients aside; that of a copy where they are not contiguous."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]
