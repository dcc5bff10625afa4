"""Data-parallel training: each process trains on a part of every batch.

The result equals training on the whole batch in one process, because random numbers do not depend on the process
(`nerfro.core.draws`), and because all processes have equally many pixels, so that gradients can be averaged.
"""

from __future__ import annotations

import torch.distributed as dist
from torch import Tensor


def rank_and_size() -> tuple[int, int]:
    """Return the rank of this process and the number of processes; (0, 1) without distributed training."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def share_of(num: int, rank: int, size: int) -> slice:
    """Return the part of `num` pixels for process `rank` of `size` processes."""
    return slice(rank * num // size, (rank + 1) * num // size)


def sum_over_processes(value: Tensor) -> Tensor:
    """Sum a tensor without gradient over all processes; every process must call this function."""
    if rank_and_size()[1] > 1:
        value = value.clone()
        dist.all_reduce(value)
    return value


def leave() -> None:
    """Destroy the process group, so that the processes may end at different times."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()
