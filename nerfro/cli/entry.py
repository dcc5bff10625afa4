"""Entry points of commands: help, flags, and the checked configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import hydra
import hydra._internal.hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue

from nerfro.cli.composition import BoundedFiles, composed_with
from nerfro.cli.failures import errors_in_one_line, in_one_line
from nerfro.cli.options import ADDED_GROUPS, Described, describe_command, recall, remember, usage
from nerfro.cli.overrides import full_key, is_scene_file
from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR
from nerfro.core.trust import leave_current_directory
from nerfro.registry.allowed import check_names, check_settings
from nerfro.registry.registration import discover

_HELP = {"-h", "--help"}


def entry_point(
    config_name: str,
    schema: type,
    config_dir: Path = CONF_DIR,
    verbatim: tuple[str, ...] = (),
    check: Callable[[DictConfig], None] | None = None,
    expand: Callable[[list[str], list[str]], list[str]] | None = None,
) -> Callable[[Callable[[DictConfig], float | None]], Callable[[], None]]:
    """Decorate the main function of a command, which receives a checked configuration.

    The defaults list of the YAML file must begin with `<config_name>_schema`. Otherwise Hydra does not refuse misspelt
    keys of the root.

    Args:
        config_name: name of the YAML file in `config_dir`, without extension.
        schema: dataclass of the root.
        config_dir: conf/, or a folder in it for a command that must not see the groups of conf/.
        verbatim: keys whose values are texts that may contain commas and equals signs, which Hydra would parse.
        check: further check of the configuration.
        expand: function that replaces arguments that stand for several settings; it also receives the names of the
            settings of the root.
    """

    def decorate(task: Callable[[DictConfig], float | None]) -> Callable[[], None]:
        def check_all(config: DictConfig) -> None:
            with _missing_with_example(config_name):
                check_configuration(config, schema, config_dir)
                if check is not None:
                    check(config)

        def start() -> None:
            failures: list[Exception] = []
            os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise, Hydra prints its own report and exits
            with composed_with(check_all):
                ConfigStore.instance().store(name=f"{config_name}_schema", node=schema, provider="nerfro")
                SourcesRegistry.instance().types["file"] = BoundedFiles
                leave_current_directory()
                discover()
                _answer_questions(config_name, schema, config_dir)
                sys.argv[1:] = [_quoted(full_key(argument), verbatim) for argument in sys.argv[1:]]
                if expand is not None:
                    sys.argv[1:] = expand(sys.argv[1:], [field.name for field in dataclasses.fields(schema)])
                if config_name == "train":
                    sys.argv[1:] = map(added, sys.argv[1:])
                job = _job(task, config_name, failures)
                with _run_folder():
                    hydra.main(version_base="1.3", config_path=str(config_dir), config_name=config_name)(job)()
            if failures:
                raise failures[0]

        @functools.wraps(task)
        def run() -> None:
            with errors_in_one_line():
                start()

        return run

    return decorate


def _answer_questions(config_name: str, schema: type, config_dir: Path) -> None:
    """Answer --help, and refuse misspelt names unless `startup` has done so; flags move before the overrides."""
    if _HELP & set(sys.argv) and "hydra" in sys.argv:
        sys.argv[1:] = ["--hydra-help"]
    sys.argv[1:] = _flags_first(sys.argv[1:])
    if _HELP & set(sys.argv) or (program() == config_name and recall(config_name) is None):
        described = describe_command(config_name, schema, config_dir)
        remember(config_name, described)
        answer(described, sys.argv[1:])


def _job(
    task: Callable[[DictConfig], float | None], config_name: str, failures: list[Exception]
) -> Callable[[DictConfig], float | None]:
    """Return the function that Hydra calls. The error of a single run is appended to `failures`.

    Hydra would print an additional line for an error that is raised.
    """

    @functools.wraps(task)
    def job(config: DictConfig) -> float | None:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return _job_of_sweep(task, config)
        try:
            with _missing_with_example(config_name):
                return task(config)
        except Exception as error:
            failures.append(error)
            return None

    return job


def _job_of_sweep(task: Callable[[DictConfig], float | None], config: DictConfig) -> float | None:
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


@contextlib.contextmanager
def _missing_with_example(command: str) -> Iterator[None]:
    """Show an example of the command if a required option is missing."""
    try:
        yield
    except MissingMandatoryValue as error:
        example = usage(command).partition("Examples:\n")[2].partition("\n")[0].strip()
        raise NerfroError(f"{error.full_key}=... is missing; for example: {example}") from error


def print_version() -> None:
    """Print the version of nerfro."""
    print(f"nerfro {importlib.import_module('nerfro').__version__}")


def program() -> str | None:
    """Return the name of the command of this process, such as `train`; None for other programs."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    package, _, name = ("" if spec is None else spec.name).partition(".")
    return name if package == "nerfro" else None


def check_configuration(config: DictConfig, schema: type, config_dir: Path) -> None:
    """Refuse names and values of settings that are invalid for the dataclass of a command.

    Raises:
        NerfroError: a setting is not allowed.
    """
    check_names(config, groups=[path.name for path in config_dir.iterdir() if path.is_dir()])
    check_settings(config, schema)


def _flags_first(arguments: list[str]) -> list[str]:
    """Move Hydra's flags before the overrides, because its parser accepts no overrides after a flag among them."""
    parser = get_args_parser()
    parser.error = _refuse_flag  # type: ignore[method-assign]  # argparse prints its usage before the message
    known, others = parser.parse_known_args(arguments)
    flag = next((text for text in others if text.startswith("-")), None)
    if flag is not None:
        raise NerfroError(f"{flag} is not an option; write key=value, or see --help")
    if (known.resolve or known.package) and not known.cfg:
        raise NerfroError("--resolve and --package need --cfg; write --cfg job --resolve to print the resolved values")
    if known.experimental_rerun is not None:
        raise NerfroError("--experimental-rerun executes code of the file that it reads; use config.yaml of the run")
    overrides = [*known.overrides, *others]
    return [text for text in arguments if text not in overrides] + overrides


def answer(described: Described, arguments: list[str]) -> None:
    """Print the help on request, or refuse misspelt names.

    Raises:
        NerfroError: a setting or an option does not exist.
    """
    if _HELP & set(arguments) and "hydra" not in arguments:
        print(described.help)
        sys.exit()
    unknown = any(argument.startswith(("--config", "-c", "hydra.searchpath")) for argument in arguments)
    if not unknown:  # other folders of configurations may have other groups
        if {"data", "medium"} & {*described.names.get("", ())}:
            arguments = [text for text in arguments if not is_scene_file(text)]
        described.require_known([full_key(text) for text in arguments])


def _refuse_flag(message: str) -> NoReturn:
    raise NerfroError(f"{message}; --help hydra lists the flags")


def _quoted(argument: str, keys: tuple[str, ...]) -> str:
    """Quote the value of an override if its key is one of `keys`."""
    key, _, value = argument.partition("=")
    if key not in keys or not set(",=") & set(value) or value[0] in "\"'":
        return argument
    return f"{key}='{value}'"


def added(argument: str) -> str:
    """Add the plus sign with which Hydra selects an option of a group without a default, as in `experiment=glass`."""
    return f"+{argument}" if argument.partition("=")[0] in ADDED_GROUPS else argument
