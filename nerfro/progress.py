"""The bars that long work has, outside training."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tqdm import tqdm

Item = TypeVar("Item")

PATIENCE = 2.0  # seconds; what is faster has no bar


def told(what: str, items: Iterable[Item], total: int | None = None) -> Iterable[Item]:
    """The items, and on standard error how many of them are done, if they take long."""
    return tqdm(items, what, total, delay=PATIENCE, dynamic_ncols=True)


@contextmanager
def bar(what: str) -> Iterator[Callable[[float], None]]:
    """A bar with the time left, for what is told the share that is done of it."""
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        task = progress.add_task(what, total=1)
        yield lambda done: progress.update(task, completed=done)
