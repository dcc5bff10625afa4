"""Command lines of commands without configuration groups: `key=value` arguments become a dataclass."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from nerfro.cli.composition import missing_with_example
from nerfro.cli.failures import errors_in_one_line
from nerfro.cli.options import describe, recall, remember
from nerfro.core.errors import NerfroError
from nerfro.core.trust import leave_current_directory
from nerfro.registry.allowed import plain, validate
from nerfro.registry.registration import discover

Options = TypeVar("Options")
_SHOW = ("--cfg", "job")


def command(name: str, schema: type[Options]) -> Callable[[Callable[[Options], None]], Callable[[], None]]:
    """Decorate the main function of a command, which receives the checked options of the command line.

    Args:
        name: name of the command.
        schema: dataclass of the options.
    """

    def decorate(task: Callable[[Options], None]) -> Callable[[], None]:
        @functools.wraps(task)
        def run() -> None:
            with errors_in_one_line():
                leave_current_directory()
                discover()
                task(parse(name, schema, sys.argv[1:]))

        return run

    return decorate


def parse(name: str, schema: type[Options], arguments: Sequence[str]) -> Options:
    """Convert the arguments of a command line to options; `--help` and `--cfg job` print and exit.

    Args:
        name: name of the command.
        schema: dataclass of the options.
        arguments: arguments such as `views=test` or `subdivision.side=2`, in the grammar of Hydra's overrides.

    Raises:
        NerfroError: an option is unknown or missing, or its value is not allowed.
    """
    if {"-h", "--help"} & {*arguments} or recall(name) is None:
        described = describe(name, schema)
        remember(name, described)
        described.answer(arguments)
    overrides = [text for text in arguments if text not in (*_SHOW, "--resolve")]
    with missing_with_example(name):
        options = validate(schema, values_of(overrides))
    if "--cfg" in arguments:
        print(to_yaml(options), end="")
        sys.exit()
    return options


def values_of(arguments: Sequence[str]) -> dict[str, Any]:
    """Convert arguments such as `views=test` to nested values.

    Raises:
        NerfroError: an argument is a flag, or has several values.
    """
    values = OmegaConf.create({})
    for text in arguments:
        if text.startswith("-"):
            raise NerfroError(f"{text} is not an option; write key=value, or see --help")
        override = OverridesParser.create().parse_override(text)
        if override.is_sweep_override() or override.is_delete():
            raise NerfroError(f"{text} cannot be used here; write {override.key_or_group}=VALUE, and lists in brackets")
        OmegaConf.update(values, override.key_or_group, override.value(), force_add=True)
    return plain(values)


def to_yaml(options: Any) -> str:
    """Write options as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(asdict(options)))
