"""Command-line overrides in Hydra's syntax, such as `medium.ior=1.5`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence

# Short names of settings, on the command line and in YAML files.
SHORT_NAMES = {"bodies": "medium.bodies"}


def print_next(label: str, command: str, options: Sequence[str]) -> None:
    """Print the next command."""
    print(f"{label}: {command_line(command, options)}")


def command_line(command: str, options: Sequence[str]) -> str:
    """Return the line that runs a command in a shell."""
    return shlex.join(["python", "-m", f"nerfro.{command}", *options])


def full_key(override: str) -> str:
    """Replace the short name of a setting by the full one."""
    return re.sub(r"^([+~]*)(\w+)(?=[.=])", lambda key: key[1] + SHORT_NAMES.get(key[2], key[2]), override)


def is_given(option: str, overrides: Iterable[str]) -> bool:
    """Test whether overrides set an option."""
    return option in {_name(text) for text in overrides}


def not_given(options: Iterable[str], overrides: Iterable[str]) -> list[str]:
    """Select the options that overrides do not set."""
    names = {_name(text) for text in overrides}
    return [option for option in options if _name(option) not in names]


def is_scene_file(argument: str) -> bool:
    """Test whether an argument names a scene file; `scene=NAME` selects the settings of a known scene."""
    return argument.startswith("scene=") and argument.strip("'\"").endswith(".json")


def of_groups(groups: tuple[str, ...], overrides: Iterable[str]) -> list[str]:
    """Select the overrides of the given groups or options."""
    return [text for text in overrides if _name(text).split(".")[0] in groups]


def as_overrides(settings: Mapping[str, object]) -> list[str]:
    """Convert settings to overrides, and quote text with special characters of Hydra's grammar."""
    return [f"{name}={_quoted(value)}" for name, value in settings.items()]


def _name(override: str) -> str:
    return override.lstrip("+").split("=")[0]


def _quoted(value: object) -> str:
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_quoted(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_quoted, value))}]"
    text = "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    if re.fullmatch(r"[\w./+@%-]+", text, re.ASCII):
        return text
    # Hydra reads a backslash as it is, except before a quotation mark.
    return '"' + re.sub(r'(\\*)("|$)', lambda end: 2 * end[1] + ("\\" + end[2] if end[2] else ""), text) + '"'
