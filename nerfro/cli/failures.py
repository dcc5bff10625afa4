"""Errors of commands in one line, with the exit status."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import os
import re
import shlex
import sys
import tempfile
import traceback
from collections.abc import Iterator

import yaml
from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from nerfro.core.errors import NerfroError, nearest_of, one_line
from nerfro.registry.registration import SEVERAL, plugins

_NO_MEMORY = re.compile("allocate memory|out of memory")  # messages of torch on a CPU and on a GPU
# Options of Hydra that the extras of nerfro install.
_EXTRAS = {
    "hydra/launcher/joblib": "launchers",
    "hydra/launcher/submitit": "launchers",  # submitit_local and submitit_slurm
    "hydra/launcher/ray": "ray",
    "hydra/sweeper/optuna": "optuna",
}


@contextlib.contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Print any error in one line and exit with status 1. With NERFRO_DEBUG=1 the error is raised instead."""
    _accept_all_text()
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        sys.exit(141)  # the status of a program that SIGPIPE has ended, in a shell
    except KeyboardInterrupt as interruption:
        print(f"nerfro: interrupted{f'; {interruption}' if str(interruption) else ''}", file=sys.stderr)
        sys.exit(130)  # the status after SIGINT
    except Exception as error:
        if os.environ.get("NERFRO_DEBUG"):
            raise
        print(f"nerfro: error: {in_one_line(error)}", file=sys.stderr)
        sys.exit(1)


def _accept_all_text() -> None:
    """Replace characters that the encoding of the terminal lacks, and discard text for closed streams (`>&-`)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - open until the process ends
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def in_one_line(error: Exception) -> str:
    """Describe an error for the user: a mistake in the input, a missing resource, or a bug of nerfro."""
    return one_line(_description(error))


def _description(error: Exception) -> str:
    if isinstance(error, NerfroError):
        return str(error)
    if isinstance(error, OverrideParseException):
        return _not_parsed(error.override)
    if isinstance(error, yaml.YAMLError):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))):
        reason = " ".join(str(error).split("\n")[0].split())
        place = _place_in_plugin(error)
        sizes = "batches.size" if place is None else f"those in {place}"
        return f"not enough memory{reason and f' ({reason})'}; take smaller sizes, such as {sizes}"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        message = " ".join(_messages(error))
        extras = [extra for option, extra in _EXTRAS.items() if f"Could not find '{option}" in message]
        return f"{message}; pip install 'nerfro[{extras[0]}]' adds it" if extras else message
    # Hydra refuses a group without an option (field=null), and flags together, by a ValueError.
    if isinstance(error, ValueError) and any(place[0].startswith("hydra.") for place in _places(error)[-1:]):
        return f"{error}; give the name of an option, as in field=nerf, and see --help for the flags"
    if type(error).__module__.partition(".")[0] in ("joblib", "ray", "submitit"):  # for example if a worker was killed
        reason = str(error).strip().split("\n")[0].rstrip(".")
        return f"{reason} ({type(error).__name__}); repeat the command to continue the sweep"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space is left for {error.filename or 'a file'}; free some, or write to another folder"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return _unforeseen(error)


def _places(error: Exception) -> list[tuple[str, str, int]]:
    """Return module, file and line of each frame of a traceback."""
    frames = traceback.walk_tb(error.__traceback__)
    return [(frame.f_globals.get("__name__", ""), frame.f_code.co_filename, line) for frame, line in frames]


def _place_in_plugin(error: Exception) -> str | None:
    """Name the file and line of the plugin of others that raised an error; None if a plugin of nerfro raised it."""
    modules = {plugin.cls.__module__ for plugin in plugins()}
    frame = next((frame for frame in reversed(_places(error)) if frame[0] in modules), None)
    if frame is None or frame[0].startswith("nerfro."):
        return None
    return f"the plugin {frame[1]}, line {frame[2]}"


def _unforeseen(error: Exception) -> str:
    """Write the traceback of a bug to a file and return a message with the name of the file."""
    what = f"{type(error).__name__}: {error}".splitlines()[0]
    place = _place_in_plugin(error)
    if place is not None:
        return f"{what}; raised in {place} (NERFRO_DEBUG=1 shows the traceback)"
    try:
        with tempfile.NamedTemporaryFile("w", prefix="nerfro_", suffix=".txt", delete=False) as file:
            print(shlex.join(sys.argv), file=file)
            traceback.print_exception(error, file=file)
        where = f"please report it with {file.name}, which has the traceback"
    except OSError:
        where = "please report it with its traceback"
    return f"{what}; this is a bug of nerfro: {where} (NERFRO_DEBUG=1 shows it)"


def _not_parsed(override: str) -> str:
    """Describe an override that Hydra cannot parse."""
    key, equals, value = override.partition("=")
    if not equals or not key:
        return f"{override} is not an option; write key=value"
    quoted = value if value[:1] in "\"'" else '"' + value.replace('"', '\\"') + '"'
    return f"{override} cannot be read; quote the value for Hydra and for the shell: {shlex.quote(f'{key}={quoted}')}"


def _messages(error: BaseException) -> list[str]:
    """Return the lines of an error and of its cause, because Hydra names the wrong key only in the cause."""
    lines = [line.strip() for line in str(error).partition("Config search path")[0].splitlines() if line.strip()]
    if (present := re.search(r"Could not append to config\. An item is already at '([^']+)'", str(error))) is not None:
        return [f"{present[1]} has a value already; write {present[1]}=..., without a plus sign"]
    if (empty := re.search(r"Could not find '([\w/]+)/'", str(error))) is not None:
        options = ", ".join(" ".join(lines).rpartition("': ")[2].split())
        return [f"{empty[1]}= names no option; leave it out, or choose from {options}"]
    cause = error.__cause__ or error.__context__ or error
    if not isinstance(cause, OmegaConfBaseException):
        return lines
    schema = cause.object_type
    names = schema.__dataclass_fields__ if dataclasses.is_dataclass(schema) else cause.parent_node
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)) and names is not None:
        where = [f"{lines[0].partition(':')[0]}:"] if lines[0].startswith("In '") else []
        key, nearest = str(cause.full_key), nearest_of(str(cause.key), list(map(str, names)))
        return [*where, _unselected(key) or f"{key} is not a setting; {nearest}"]
    return lines + [line.strip() for line in str(cause).splitlines() if line.strip() and line.strip() not in lines]


def _unselected(key: str) -> str | None:
    """Explain how to add a missing loss or callback to the experiment; None for other settings."""
    kind, name, option = [*key.split("."), "", ""][:3]
    plugin = next((plugin for plugin in plugins() if (plugin.kind, plugin.name) == (kind, name)), None)
    if plugin is None or kind not in SEVERAL or (option and option not in plugin.hints):
        return None
    if kind != "callbacks":
        setting = option or {"loss": "weight"}.get(kind, "SETTING")
        return f"the experiment does not set {key}; write +{kind}.{name}.{setting}=..., with a plus sign"
    return f"callbacks.{name} is not selected; add +callbacks={name}"
