"""The one exception that a user's mistake turns into."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

_SHOWN = 3


class NerfroError(Exception):
    """A mistake in the input, told in one line: what was wrong, what is allowed, what to do next.

    Entry points print the message alone and exit with status 1; anything else is a bug and keeps its traceback.
    """


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with what to do to go on."""


def first_of(names: Sequence[str]) -> str:
    """The first three names, and how many more there are: a line that lists hundreds is not read."""
    shown = ", ".join(names[:_SHOWN])
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"


def nearest_of(name: str, names: Sequence[str]) -> str:
    """What to ask about a name that is none of those there are; or all of them, where none is like it."""
    names = sorted(other for other in names if other != "_target_")
    near = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {near[0]}?" if near else f"known: {', '.join(names) or 'none'}"
