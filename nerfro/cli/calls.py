"""Calls of commands from Python: typed options from keyword arguments, and compositions of overrides."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from nerfro.cli.composition import Composer, Expand
from nerfro.cli.failures import in_one_line
from nerfro.cli.options import describe
from nerfro.core.errors import NerfroError
from nerfro.registry.allowed import plain, validate
from nerfro.registry.registration import plugin_of

Options = TypeVar("Options")


def options_of(
    schema: type[Options], options: Options | None, settings: Mapping[str, object], **arguments: object
) -> Options:
    """Check the options of a command, given as a dataclass, as keyword arguments, or as both.

    Args:
        schema: dataclass of the options.
        options: the options; None for the defaults.
        settings: keyword arguments, which have precedence; paths may be objects.
        **arguments: further settings; None leaves the value of `options`.

    Raises:
        NerfroError: a name is unknown, or a value is missing or not allowed.
    """
    values = {} if options is None else vars(options)
    changes = {name: value for name, value in arguments.items() if value is not None}
    return validate(schema, {**values, **settings, **changes})


def values_of(arguments: Sequence[str]) -> dict[str, Any]:
    """Convert arguments such as `views=test` or `subdivision.side=2` to nested values.

    Raises:
        NerfroError: an argument has several values.
    """
    values = OmegaConf.create({})
    for override in OverridesParser.create().parse_overrides(list(arguments)):
        key, text = override.key_or_group, override.input_line
        if override.is_sweep_override() or override.is_delete():
            raise NerfroError(f"{text} cannot be used here; write {key}=VALUE, and lists in brackets")
        OmegaConf.update(values, key, override.value(), force_add=True)
    return plain(values)


def changed_settings(options: object) -> dict[str, Any]:
    """Return the settings of a dataclass with other values than the defaults, for example to print a command line."""
    defaults = dataclasses.asdict(type(options)())  # type: ignore[call-overload]
    values = dataclasses.asdict(options)  # type: ignore[call-overload]
    return {name: value for name, value in values.items() if value != defaults[name]}


@dataclass(frozen=True)
class Composition:
    """A configuration that is composed of groups and checked.

    Attributes:
        config: the configuration.
        choices: selected option of each group.
        overrides: the overrides in the configuration.
        folder: folder of the run.
    """

    config: DictConfig
    choices: Mapping[str, str]
    overrides: list[str]
    folder: Path

    @classmethod
    def of_job(cls, config: DictConfig) -> Composition:
        """Return the composition of the current job of Hydra."""
        job = HydraConfig.get()
        return cls(config, job.runtime.choices, list(job.overrides.task), Path(job.runtime.output_dir))

    def described(self, group: str) -> dict[str, Any]:
        """Describe a component by its type and the settings with other values than the defaults of the class."""
        node = self.config[group]
        defaults = {name: default for name, _, default in plugin_of(node).fields()}
        values = cast(dict[str, Any], OmegaConf.to_container(node, resolve=True))
        del values["_target_"]
        changed = {name: value for name, value in values.items() if value != defaults.get(name)}
        return {"type": self.choices[group]} | changed


@contextlib.contextmanager
def composed(
    command: str,
    schema: type,
    overrides: Sequence[str],
    expand: Expand,
    check: Callable[[DictConfig], None] | None = None,
    config_dir: str | Path | None = None,
) -> Iterator[Composition]:
    """Compose the configuration of a command for a call from Python.

    Inside the context, the command is the current job of Hydra and the main program, so that records contain its
    command line, and Lightning starts further processes of a training with this command line.

    Args:
        command: name of the command.
        schema: dataclass of the root of the configuration.
        overrides: settings as on the command line.
        expand: function that replaces overrides that stand for several settings, see `Composer`.
        check: further check of the configuration.
        config_dir: further folder of YAML files, as `--config-dir`.

    Raises:
        NerfroError: a setting does not exist, or its value is not allowed.
    """

    composer = Composer(command, schema, check, expand)
    arguments = composer.overrides(overrides)
    folders = [] if config_dir is None else [str(config_dir)]
    try:
        with composer.hydra(folders) as hydra:
            job = hydra.compose_config(command, arguments, RunMode.RUN, with_log_configuration=False, from_shell=False)
    except HydraException as error:
        if not folders:  # which may have other groups
            describe(command, schema).require_known(arguments)
        raise NerfroError(in_one_line(error)) from error
    with open_dict(job):
        job.hydra.runtime.output_dir = job.hydra.run.dir
    config = copy.deepcopy(job)
    with open_dict(config):
        del config["hydra"]
    with _as_main_program(command, [*arguments, *(f"--config-dir={folder}" for folder in folders)], job):
        yield Composition.of_job(config)


@contextlib.contextmanager
def _as_main_program(command: str, arguments: Sequence[str], job: DictConfig) -> Iterator[None]:
    main, hydra = sys.modules["__main__"], HydraConfig.instance()
    spec, argv, outer = getattr(main, "__spec__", None), sys.argv, hydra.cfg
    main.__spec__, sys.argv = find_spec(f"nerfro.{command}"), [command, *arguments]
    hydra.set_config(job)
    try:
        yield
    finally:
        main.__spec__, sys.argv, hydra.cfg = spec, argv, outer
