"""The one exception that a user's mistake turns into."""

from __future__ import annotations

from collections.abc import Sequence

_SHOWN = 3


class NerfroError(Exception):
    """A mistake in the input, told in one line: what was wrong, what is allowed, what to do next.

    Entry points print the message alone and exit with status 1; anything else is a bug and keeps its traceback.
    """


def first_of(names: Sequence[str]) -> str:
    """The first three names, and how many more there are: a line that lists hundreds is not read."""
    shown = ", ".join(names[:_SHOWN])
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"
