"""Conversion of tensors to the arrays that compiled kernels take."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Return CPU tensors as NumPy arrays without gradients, sharing memory if the tensors are contiguous."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def input_arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Return tensors on any device as NumPy arrays that a kernel only reads; see `arrays`."""
    return arrays(*(tensor.cpu() for tensor in tensors))
