"""Progress bars for long work outside training."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar("Item")

DELAY = 2.0  # seconds after which a bar appears, so that short work has none
_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"


def track(description: str, items: Iterable[Item], total: int | None = None) -> Iterable[Item]:
    """Iterate over items and show a progress bar with the remaining time on standard error."""
    return tqdm(items, description, total, delay=DELAY, dynamic_ncols=True)


@contextmanager
def bar(description: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar with the remaining time; the yielded function sets the completed fraction in [0, 1]."""
    with tqdm(total=1.0, desc=description, bar_format=_FORMAT, delay=DELAY, dynamic_ncols=True) as progress:
        yield lambda done: progress.update(done - progress.n)
