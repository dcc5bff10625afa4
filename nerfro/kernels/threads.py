"""How many threads compiled kernels use."""

from __future__ import annotations

import numba
import torch


def use_threads() -> int:
    """Let the kernels called next use as many threads as PyTorch does; returns their number."""
    available: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # Numba sets it while importing
    threads = min(torch.get_num_threads(), available)
    numba.set_num_threads(threads)
    return threads
