"""Threads of Python that divide the work of PyTorch and of kernels."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

from nerfro.kernels.compilation import HELPERS, share

Result = TypeVar("Result")


def share_rows(task: Callable[[slice], Result], like: Tensor, size: int) -> list[Result]:
    """Call a function for chunks of rows without gradients, on all cores of PyTorch.

    Args:
        task: function of the rows of a chunk.
        like: tensor with all rows. If it is on a GPU, one chunk follows the other.
        size: number of rows that all threads together process at a time, which limits the memory.

    Returns:
        Results in the order of the chunks.
    """
    number_of_rows = max(len(like), 1)
    if like.device.type != "cpu":
        with torch.no_grad():
            return [task(slice(i, i + size)) for i in range(0, number_of_rows, size)]
    with helping_threads() as number:
        size = -(-size // number)
        chunks = [slice(i, i + size) for i in range(0, number_of_rows, size)]
        return share(lambda i: task(chunks[i]), len(chunks))


def share_parts(task: Callable[[slice], Result], num_rows: int) -> list[Result]:
    """Call a kernel for equal parts of rows, one for each helping thread, see `share`.

    A thread that makes batches is a helping thread itself, and a machine with two cores has no other one.
    """
    size = max(1, -(-num_rows // max(1, len(HELPERS))))
    parts = [slice(i, i + size) for i in range(0, max(num_rows, 1), size)]
    return share(lambda i: task(parts[i]), len(parts))


def start_helpers(number: int) -> list[ThreadPoolExecutor]:
    """Start threads that help with `share` while they are idle; PyTorch uses one core in each of them."""
    helpers = [ThreadPoolExecutor(1, "helper", lambda: torch.set_num_threads(1)) for _ in range(number)]
    for helper in helpers:
        helper.submit(torch.get_num_threads).result()  # starts the thread, which inherits a number of threads
    HELPERS.extend(helpers)
    return helpers


def end_helpers(helpers: list[ThreadPoolExecutor]) -> None:
    """End threads of `start_helpers`, and cancel the work that they have not begun."""
    for helper in helpers:
        HELPERS.remove(helper)
        helper.shutdown(cancel_futures=True)


@contextlib.contextmanager
def helping_threads() -> Iterator[int]:
    """Let `share` use a thread for each core of PyTorch; PyTorch uses one core in each of them meanwhile.

    Large tasks divide better among threads of Python than small operators among threads of PyTorch.

    Yields:
        Number of threads that `share` uses, with the calling thread.
    """
    number = torch.get_num_threads()  # 1 within another such context
    helpers = start_helpers(number - 1)
    torch.set_num_threads(1)
    try:
        yield 1 + len(HELPERS)
    finally:
        torch.set_num_threads(number)
        for helper in helpers:
            # A thread ends with its executor, to which `share` of another thread may still give work.
            HELPERS.remove(helper)
