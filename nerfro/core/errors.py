"""Exceptions with messages for users, warnings, lists of names in messages, and import of optional packages."""

from __future__ import annotations

import difflib
import importlib
import re
from collections.abc import Sequence
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


def warn(message: str) -> None:
    """Print a warning about an allowed but suspicious input or result."""
    print(f"nerfro: warning: {one_line(message)}")


def optional(module: str, extra: str, purpose: str, alternative: str = "") -> Any:
    """Import a module of an optional package where it is used.

    Args:
        module: full name of the module, such as `pyarrow.parquet`.
        extra: extra of nerfro that installs the package.
        purpose: beginning of the error message, such as "target=colmap needs pycolmap".
        alternative: end of the error message: what to do instead of the installation.

    Raises:
        NerfroError: the package cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NerfroError(f"{purpose} ({error}); pip install 'nerfro[{extra}]'{alternative}") from error
