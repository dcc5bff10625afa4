"""Exceptions with messages for users, and lists of names in messages."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

_SHOWN = 3


class NerfroError(Exception):
    """Invalid input; the message states in one line the wrong value, the allowed values, and the next step.

    Commands print the message and exit with status 1. Any other exception is a bug, and its traceback is printed.
    """


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; the message states how to resume."""


def first_of(names: Sequence[str]) -> str:
    """Format the first three names, and the number of the others, because long lists are not read."""
    shown = ", ".join(names[:_SHOWN])
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"


def nearest_of(name: str, names: Sequence[str]) -> str:
    """Suggest the most similar of the known names, or list all known names if none is similar."""
    names = sorted(other for other in names if other != "_target_")
    near = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {near[0]}?" if near else f"known: {', '.join(names) or 'none'}"
