"""Several processes that train one model, each on its share of a batch.

They shall learn what one process would learn from the whole batch. So every process draws the random numbers of all
rays and keeps those of its own, and what is normalised over a batch is normalised over all of it.
"""

from __future__ import annotations

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor


def rank_and_size() -> tuple[int, int]:
    """Number of this process, and how many there are; (0, 1) outside of distributed training."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def share_of(num: int, rank: int, size: int) -> slice:
    """The part of `num` rays that is process `rank`'s, if `size` processes share them evenly."""
    return slice(rank * num // size, (rank + 1) * num // size)


def rand_rays(num_rays: int, num_samples: int, like: Tensor) -> Float[Tensor, "R N"]:
    """Uniform numbers in [0, 1) for the rays of this process: its rows of those that one process would draw.

    All processes have the same seed, so they go on drawing the same numbers afterwards.

    Args:
        num_rays: of this process; every process has as many.
        num_samples: numbers for each ray.
        like: gives device and type.
    """
    rank, size = rank_and_size()
    everything = torch.rand(size * num_rays, num_samples, device=like.device, dtype=like.dtype)
    return everything[share_of(len(everything), rank, size)]


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
