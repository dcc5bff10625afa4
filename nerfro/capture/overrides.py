"""Command-line overrides in Hydra's syntax, such as `medium.ior=1.5`."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence

from nerfro.files.folder_lock import STAGE


def print_hint(text: str) -> None:
    """Print what the user may do next, unless nerfro.reconstruct runs the next stage."""
    if STAGE not in os.environ:
        print(text)


def print_next(label: str, command: str, options: Sequence[str]) -> None:
    """Print the command that follows as a hint."""
    print_hint(f"{label}: {shlex.join(['python', '-m', f'nerfro.{command}', *options])}")


def is_given(option: str, overrides: Iterable[str]) -> bool:
    """Test whether overrides set an option."""
    return option in {_name(text) for text in overrides}


def of_groups(groups: tuple[str, ...], overrides: Iterable[str]) -> list[str]:
    """Select the overrides of some groups, or of options with these names."""
    return [text for text in overrides if _name(text).split(".")[0] in groups]


def as_overrides(settings: Mapping[str, object]) -> list[str]:
    """Convert settings to overrides, with quotes around text that Hydra would not read as a single text."""
    return [f"{name}={_quoted(value)}" for name, value in settings.items()]


def _name(override: str) -> str:
    return override.lstrip("+").split("=")[0]


def _quoted(value: object) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(_quoted, value))}]"
    text = str(value)
    if re.fullmatch(r"[\w./+@%-]+", text, re.ASCII):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
