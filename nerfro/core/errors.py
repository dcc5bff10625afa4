"""Exceptions with messages for users, warnings, and lists of names in messages."""

from __future__ import annotations

import difflib
import functools
import operator
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

_SHOWN = 3
_LONGEST_LINE = 1000  # characters of an error; the middle of longer ones is left out


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
    names = sorted({*names} - {"_target_"})
    near = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {near[0]}?" if near else f"known: {', '.join(names) or 'none'}"


def one_line(text: str) -> str:
    """Escape control characters, which names of files may contain, and shorten a line with long values of a file."""
    line = re.sub(r"[\x00-\x1f\x7f]", lambda character: repr(character[0])[1:-1], text)
    return line if len(line) <= _LONGEST_LINE else f"{line[: _LONGEST_LINE // 2]} ... {line[-_LONGEST_LINE // 4 :]}"


def warn_of_old_name(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that a Python name has changed; by default, the caller of the calling function."""
    warnings.warn(f"{old} is called {new}; the next release removes the old name", stacklevel=stacklevel)


def renamed_classes(module: str, **classes: type) -> Callable[[str], Any]:
    """Return the function `__getattr__` of a module, which finds classes by their old names, with a warning."""

    def find(name: str) -> Any:
        if name not in classes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warn_of_old_name(f"{module}.{name}", f"{module}.{classes[name].__name__}")
        return classes[name]

    return find


def accept_old_methods(cls: type, names: Mapping[str, str]) -> None:
    """Let methods that a class defines under one name, old or new, be used by both; the old one with a warning.

    Args:
        cls: a base class, or a class in `__init_subclass__` of its base class.
        names: new names by old name.
    """
    for old, new in names.items():
        former, present = cls.__dict__.get(old), cls.__dict__.get(new)
        if former is not None and present is None:
            warn_of_old_name(f"{cls.__name__}.{old}", new, stacklevel=4)
            setattr(cls, new, former)
        elif former is None and present is not None:
            setattr(cls, old, _under_old_name(present, f"{cls.__name__}.{old}", new))


def accept_old_fields(cls: Any, names: Mapping[str, str]) -> None:
    """Let fields of a dataclass be read, and be passed to its constructor by keyword, under old names with a warning.

    Args:
        cls: a dataclass.
        names: new names by old name.
    """
    construct = cls.__init__

    @functools.wraps(construct)
    def construct_renamed(self: Any, *values: Any, **named: Any) -> None:
        for old in names.keys() & named.keys():
            warn_of_old_name(f"{cls.__name__}.{old}", names[old])
            named[names[old]] = named.pop(old)
        construct(self, *values, **named)

    cls.__init__ = construct_renamed
    for old, new in names.items():
        setattr(cls, old, property(_under_old_name(operator.attrgetter(new), f"{cls.__name__}.{old}", new)))


def _under_old_name(method: Callable[..., Any], old: str, new: str) -> Callable[..., Any]:
    def renamed(self: Any, *args: Any, **named: Any) -> Any:
        warn_of_old_name(old, new)
        return method(self, *args, **named)

    return renamed


def warn(message: str) -> None:
    """Print a warning about an allowed but suspicious input or result."""
    print(f"nerfro: warning: {one_line(message)}")
