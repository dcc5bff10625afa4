"""Several processes that train one model, each on its share of a batch.

They shall learn what one process would learn from the whole batch. So every process draws the random numbers of all
rays and keeps those of its own, and what is normalised over a batch is normalised over all of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
import torch.distributed as dist
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.errors import NerfroError

_own_rows: ContextVar[tuple[Tensor, int] | None] = ContextVar("own_rows", default=None)


def rank_and_size() -> tuple[int, int]:
    """Number of this process, and how many there are; (0, 1) outside of distributed training."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def share_of(num: int, rank: int, size: int) -> slice:
    """The part of `num` rays that is process `rank`'s, if `size` processes share them evenly."""
    return slice(rank * num // size, (rank + 1) * num // size)


@contextmanager
def drawing_for(rows: Int[Tensor, "R"] | None, num_rows: int | None) -> Iterator[None]:
    """Inside of it, `rand_rays` draws for all `num_rows` rays of a batch of which this process has some.

    Without rows, every process has as many rays as all others, one process's after another's.
    """
    token = _own_rows.set(None if rows is None or num_rows is None else (rows, num_rows))
    try:
        yield
    finally:
        _own_rows.reset(token)


def rand_rays(num_rays: int, num_samples: int, like: Tensor) -> Float[Tensor, "R N"]:
    """Uniform numbers in [0, 1) for the rays of this process: its rows of those that one process would draw.

    All processes have the same seed, so they go on drawing the same numbers afterwards.

    Args:
        num_rays: of this process.
        num_samples: numbers for each ray.
        like: gives device and type.

    Raises:
        NerfroError: inside of `drawing_for`, for another number of rays than this process has of the batch.
    """
    if (own := _own_rows.get()) is not None:
        rows, num_rows = own
        if num_rays != len(rows):
            raise NerfroError(
                f"random numbers were asked for {num_rays} rays, but the batch has {len(rows)}; draw them once "
                "for each ray (Path.rand does, and serves all polylines of a ray), or in a loss"
            )
        return torch.rand(num_rows, num_samples, device=like.device, dtype=like.dtype)[rows]
    rank, size = rank_and_size()
    everything = torch.rand(size * num_rays, num_samples, device=like.device, dtype=like.dtype)
    return everything[share_of(len(everything), rank, size)]


def mean_over_rays(values: Float[Tensor, "R"], num_rows: int | None) -> Float[Tensor, ""]:
    """Mean over the rays of a batch, of which processes may have unequal numbers.

    Args:
        values: of this process's rays.
        num_rows: of the whole batch; None where all processes have as many.
    """
    # Processes average their gradients: each brings its sum as often as there are processes.
    return values.mean() if num_rows is None else values.sum() * rank_and_size()[1] / num_rows


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
