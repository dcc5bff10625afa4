"""Conversion of tensors to the arrays that compiled kernels take."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Return tensors as NumPy arrays without gradients; contiguous tensors on the CPU share their memory."""
    return [tensor.detach().cpu().contiguous().numpy() for tensor in tensors]
