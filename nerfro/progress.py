"""The bar that long work before training has."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar("Item")

PATIENCE = 2.0  # seconds; what is faster has no bar


def told(what: str, items: Iterable[Item], total: int | None = None) -> Iterable[Item]:
    """The items, and on standard error how many of them are done, if they take long."""
    return tqdm(items, what, total, delay=PATIENCE, dynamic_ncols=True)
