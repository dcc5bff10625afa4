"""How many threads compiled kernels use."""

from __future__ import annotations

import numba
import torch


def use_threads() -> int:
    """Let the kernels called next use as many threads as PyTorch does; returns their number."""
    threads = min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    return threads
