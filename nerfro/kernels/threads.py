"""The threads that compiled kernels run on."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator

import numba
import torch

# Numba's work queue aborts the process if two threads launch parallel loops at the same time.
_ONE_CALLER = threading.Lock()


def num_threads() -> int:
    """Return the number of threads for kernels that the calling thread launches: as many as PyTorch uses."""
    available: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # Numba sets it while importing
    return min(torch.get_num_threads(), available)


@contextlib.contextmanager
def parallel_threads() -> Iterator[None]:
    """Reserve Numba's threads for one parallel kernel; other threads of Python wait until it has finished."""
    with _ONE_CALLER:
        _start_threads()
        numba.set_num_threads(num_threads())
        yield


@functools.cache
def _start_threads() -> None:
    """Start Numba's threads as a work queue, unless the process has chosen another threading layer.

    OpenMP threads spin while they wait. Numba and PyTorch have a pool of threads each, and the two pools would keep
    each other from the cores: a training step took five times as long. Threads of the work queue sleep while they wait.
    """
    with contextlib.suppress(ValueError):
        numba.threading_layer()
        return  # The threads run already.
    chosen = numba.config.THREADING_LAYER  # type: ignore[attr-defined]
    try:
        if chosen == "default":
            numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]
        numba.get_num_threads()  # Numba reads its configuration and starts the threads at the first such call.
    finally:
        numba.config.THREADING_LAYER = chosen  # type: ignore[attr-defined]
