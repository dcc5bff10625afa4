"""The threads that compiled kernels run on."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import TypeVar

import numba
import torch

# Numba's work queue aborts the process if two threads launch parallel loops at the same time.
_ONE_CALLER = threading.Lock()
# Threads that help with `share` while they are idle.
HELPERS: list[Executor] = []
Result = TypeVar("Result")


def share(task: Callable[[int], Result], number: int) -> list[Result]:
    """Call a function for all numbers from 0, without gradients, in this thread and in helping threads that are idle.

    The thread of a call depends on the speed of the threads, so the results must not depend on the thread.

    Args:
        task: function of a number.
        number: number of calls.

    Returns:
        Results in the order of the numbers.
    """
    results: dict[int, Result] = {}
    numbers = iter(range(number))

    inference = torch.is_inference_mode_enabled()  # a mode of the thread

    def work() -> None:
        with torch.inference_mode(inference), torch.no_grad():
            for i in numbers:
                results[i] = task(i)

    begun = [thread.submit(work) for thread in HELPERS if number > 1]
    try:
        work()
    finally:
        for help in begun:
            # The work of a busy thread has not begun and is cancelled, because nothing is left to do.
            if not help.cancel():
                help.result()
    return [results[i] for i in range(number)]


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
    configured = numba.config.THREADING_LAYER  # type: ignore[attr-defined]
    try:
        if configured == "default":
            numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]
        numba.get_num_threads()  # Numba reads its configuration and starts the threads at the first such call.
    finally:
        numba.config.THREADING_LAYER = configured  # type: ignore[attr-defined]
