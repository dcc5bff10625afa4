"""What every entry point shares: composing the configuration, and telling a user's mistake in one line."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nerfro.allowed import check_settings
from nerfro.errors import NerfroError
from nerfro.paths import CONF_DIR
from nerfro.registry import discover, fields_of_config

EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141  # as a shell tells of a program that SIGPIPE ended


def entry_point(
    config_name: str, schema: type, config_dir: Path = CONF_DIR, verbatim: tuple[str, ...] = ()
) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Decorate `main(cfg)` so that it is composed from <config_dir>/<config_name>.yaml, checked against a dataclass.

    The YAML's defaults list must begin with `<config_name>_schema`, or misspelt root keys pass unnoticed.

    Args:
        config_name: file in `config_dir`, without extension.
        schema: dataclass of the root.
        config_dir: conf/, or a folder in it whose entry point must not see the groups of conf/.
        verbatim: keys of texts that may have commas, which Hydra would take for several values.
    """

    def decorate(task: Callable[[DictConfig], None]) -> Callable[[], None]:
        @functools.wraps(task)
        def job(config: DictConfig) -> None:
            with errors_in_one_line():  # inside the job too, or Hydra prints a line of its own first
                check_settings(config, schema)
                task(config)

        @functools.wraps(task)
        def run() -> None:
            # Without this Hydra prints its own report of errors and exits, before we can.
            os.environ["HYDRA_FULL_ERROR"] = "1"
            with errors_in_one_line():
                ConfigStore.instance().store(name=f"{config_name}_schema", node=schema, provider="nerfro")
                discover()
                sys.argv[1:] = [_quoted(argument, verbatim) for argument in sys.argv[1:]]
                hydra.main(version_base="1.3", config_path=str(config_dir), config_name=config_name)(job)()

        return run

    return decorate


@contextlib.contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Tell a user's mistake in one line and exit with status 1; a bug keeps its traceback."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still to be flushed at exit
        sys.exit(EXIT_BROKEN_PIPE)
    except KeyboardInterrupt:
        print("nerfro: interrupted", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    except Exception as error:
        line = in_one_line(error)
        if line is None:
            raise
        print(f"nerfro: error: {line}", file=sys.stderr)
        sys.exit(1)


def in_one_line(error: Exception) -> str | None:
    """What to tell the user about a mistake of theirs; None for a bug."""
    if isinstance(error, NerfroError):
        return str(error)
    if isinstance(error, OverrideParseException):
        return _not_parsed(error.override)
    if isinstance(error, yaml.YAMLError):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"not enough memory ({error}); take smaller sizes" if str(error) else "not enough memory"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return " ".join(_messages(error))
    # Hydra's refusal of a group that is set to no option (field=null); any other ValueError is a bug.
    if isinstance(error, ValueError) and str(error).startswith("Config group override"):
        return f"{error}; give the name of an option, as in field=nerf"
    if isinstance(error, OSError):
        return f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return None


def _quoted(argument: str, keys: tuple[str, ...]) -> str:
    """An override of one of some keys, with its value as a quoted text."""
    key, _, value = argument.partition("=")
    if key not in keys or "," not in value or value[0] in "\"'":
        return argument
    return f"{key}='{value}'"


def _not_parsed(override: str) -> str:
    """What to tell about an override that Hydra's grammar does not allow."""
    key, equals, value = override.partition("=")
    if not equals or not key:
        return f"{override} is no option; write key=value"
    quoted = value if value[:1] in "\"'" else '"' + value.replace('"', '\\"') + '"'
    return f"{override} cannot be read; quote the value for Hydra and for the shell: {shlex.quote(f'{key}={quoted}')}"


def _messages(error: BaseException) -> list[str]:
    """An error's lines and its cause's, joined to one; Hydra keeps the name of the bad key in the cause."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    cause = error.__cause__
    if cause is not None and isinstance(cause, OmegaConfBaseException):
        lines += [line.strip() for line in str(cause).splitlines() if line.strip() and line.strip() not in lines]
    refused = re.search(r"not in '(\w+)'", " ".join(lines))
    fields = None if refused is None else fields_of_config(refused[1])
    return lines if fields is None else [*lines, f"fields: {', '.join(fields)}"]


def warn(message: str) -> None:
    """Tell the user of something that is allowed but looks wrong."""
    print(f"nerfro: warning: {message}")
