"""Entry points of commands: help, flags, and the checked configuration or options."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from nerfro.cli.calls import values_of
from nerfro.cli.composition import SWEEP, Composer, Expand, missing_with_example
from nerfro.cli.failures import errors_in_one_line, in_one_line
from nerfro.cli.options import describe, has_groups, recall, remember
from nerfro.core.errors import NerfroError
from nerfro.core.trust import leave_current_directory
from nerfro.registry.allowed import validate
from nerfro.registry.registration import discover

Task = Callable[[Any], float | None]


def entry_point(
    command: str,
    schema: type,
    verbatim: tuple[str, ...] = (),
    check: Callable[[DictConfig], None] | None = None,
    expand: Expand | None = None,
    check_inputs: Callable[[DictConfig], None] | None = None,
) -> Callable[[Task], Callable[[], None]]:
    """Decorate the main function of a command, which receives a checked configuration.

    A command without a YAML file in conf/ has no groups, and receives its options as a dataclass. The defaults list of
    the YAML file must begin with `<command>_schema`. Otherwise Hydra does not refuse misspelt keys of the root.

    Args:
        command: name of the command, and of its YAML file in conf/.
        schema, verbatim, check, expand, check_inputs: see `Composer`.
    """
    composer = Composer(command, schema, check, expand, verbatim, check_inputs)

    def decorate(task: Task) -> Callable[[], None]:
        @functools.wraps(task)
        def run() -> None:
            with errors_in_one_line():
                leave_current_directory()
                _run(composer, task, sys.argv[1:])

        return run

    return decorate


def _run(composer: Composer, task: Task, arguments: list[str]) -> None:
    """Answer questions about the command, or run it."""
    command, parser = composer.command, get_args_parser()
    flags = _flags(parser, arguments)
    asks_hydra = flags.help and "hydra" in arguments and has_groups(command)
    if not asks_hydra and (flags.help or (program() == command and recall(command) is None)):
        discover()
        described = describe(command, composer.schema)
        remember(command, described)
        described.answer(arguments)
    flags.overrides = [] if asks_hydra else composer.overrides(flags.overrides)
    if has_groups(command):
        _run_by_hydra(composer, task, flags, parser)
    else:
        _run_without_groups(composer, task, flags)


def _run_without_groups(composer: Composer, task: Task, flags: Namespace) -> None:
    for name, value in vars(flags).items():
        if value and name not in ("overrides", "help", "cfg", "resolve"):
            raise NerfroError(f"--{name.replace('_', '-')} is not an option; write key=value, or see --help")
    discover()
    with missing_with_example(composer.command):
        options: Any = validate(composer.schema, values_of(flags.overrides))
    if flags.cfg:
        print(OmegaConf.to_yaml(OmegaConf.create(dataclasses.asdict(options))), end="")
    else:
        task(options)


def _run_by_hydra(composer: Composer, task: Task, flags: Namespace, parser: ArgumentParser) -> None:
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise, Hydra prints its own report and exits
    command, overrides, failures = composer.command, flags.overrides, list[Exception]()
    name = flags.config_name or command
    with composer.hydra([flags.config_dir] if flags.config_dir else []) as hydra, _run_folder():
        if flags.help or flags.hydra_help:
            hydra.hydra_help(name, args_parser=parser, args=flags)
        elif flags.cfg:
            hydra.show_cfg(name, overrides, flags.cfg, flags.package, flags.resolve)
            unchecked = composer.check_printed(hydra, flags.cfg)
            print(f"nerfro: not checked: {unchecked}, which {command} checks", file=sys.stderr)
        elif flags.info:
            hydra.show_info(flags.info, name, overrides)
        elif flags.shell_completion:
            hydra.shell_completion(name, overrides)
        elif flags.multirun or SWEEP in overrides:
            hydra.multirun(name, _job(task, command, failures), [*overrides, SWEEP])
        else:
            hydra.run(name, _job(task, command, failures), overrides)
    if failures:
        raise failures[0]


def _job(task: Task, command: str, failures: list[Exception]) -> Task:
    """Return the function that Hydra calls. The error of a single run is appended to `failures`.

    Hydra would print an additional line for an error that is raised. An empty run folder is removed then, unless it is
    the current one.
    """

    @functools.wraps(task)
    def job(config: DictConfig) -> float | None:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return _job_of_sweep(task, config)
        try:
            with missing_with_example(command):
                return task(config)
        except Exception as error:
            failures.append(error)
            folder = Path(HydraConfig.get().runtime.output_dir)
            with contextlib.suppress(OSError):  # the folder is not empty
                if folder.resolve() != Path.cwd():
                    folder.rmdir()
            return None

    return job


def _job_of_sweep(task: Task, config: DictConfig) -> float | None:
    discover()  # the process may be a launcher's worker
    try:
        return task(config)
    except Exception as error:  # Hydra's sweepers continue with the other jobs
        if os.environ.get("NERFRO_DEBUG"):
            raise
        line = f"{Path(HydraConfig.get().runtime.output_dir).name}: {in_one_line(error)}"
        print(f"nerfro: error: {line}", file=sys.stderr, flush=True)
        raise NerfroError(line) from None


@contextlib.contextmanager
def _run_folder() -> Iterator[None]:
    """Convert errors of Hydra, which creates the run folder, to one line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, (HydraException, BrokenPipeError)):
            raise
        reason = f"{error.filename or 'the folder'} cannot be used: {error.strerror}"
        raise NerfroError(f"{reason}; choose another hydra.run.dir, or hydra.sweep.dir") from error
    except ValueError as error:
        if "null byte" not in str(error):
            raise
        raise NerfroError("the name of a folder contains a null byte; choose another hydra.run.dir") from error


def print_version() -> None:
    """Print the version of nerfro."""
    print(f"nerfro {importlib.import_module('nerfro').__version__}")


def program() -> str | None:
    """Return the name of the command of this process, such as `train`; None for other programs."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    package, _, name = ("" if spec is None else spec.name).partition(".")
    return name if package == "nerfro" else None


def _flags(parser: ArgumentParser, arguments: list[str]) -> Namespace:
    """Separate the flags of Hydra from the overrides, among which they may stand.

    Raises:
        NerfroError: a flag is unknown or not allowed.
    """
    parser.error = _refuse_flag  # type: ignore[method-assign]  # argparse prints its usage before the message
    flags, others = parser.parse_known_args(arguments)
    unknown = next((text for text in others if text.startswith("-")), None)
    if unknown is not None:
        raise NerfroError(f"{unknown} is not an option; write key=value, or see --help")
    if (flags.resolve or flags.package) and not flags.cfg:
        raise NerfroError("--resolve and --package need --cfg; write --cfg job --resolve to print the resolved values")
    if flags.experimental_rerun is not None:
        raise NerfroError("--experimental-rerun executes code of the file that it reads; use config.yaml of the run")
    flags.overrides += others
    return flags


def _refuse_flag(message: str) -> NoReturn:
    raise NerfroError(f"{message}; --help hydra lists the flags")
