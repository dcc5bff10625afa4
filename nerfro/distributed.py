"""Several processes that train one model, each on its share of a batch.

They learn what one process would learn from the whole batch: random numbers do not depend on the process
(`nerfro.draws`), and all processes have equally many pixels, so that the mean of their gradients is that of the batch.
"""

from __future__ import annotations

import torch.distributed as dist
from torch import Tensor


def rank_and_size() -> tuple[int, int]:
    """Number of this process, and how many there are; (0, 1) outside of distributed training."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def share_of(num: int, rank: int, size: int) -> slice:
    """Part of `num` pixels that process `rank` has, where `size` processes share them evenly."""
    return slice(rank * num // size, (rank + 1) * num // size)


def sum_over_processes(value: Tensor) -> Tensor:
    """Sum of a tensor without gradient over all processes; every one of them must ask."""
    if rank_and_size()[1] > 1:
        value = value.clone()
        dist.all_reduce(value)
    return value


def leave() -> None:
    """End the work in common: from here on every process is alone, and may end when it likes."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()
