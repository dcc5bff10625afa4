"""Composition of configurations by Hydra, with checks and limits for files."""

from __future__ import annotations

import contextlib
import copy
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any, cast

from hydra import version
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.hydra import Hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import MissingMandatoryValue

from nerfro.cli.options import ADDED_GROUPS, global_hydra, store_schema, usage
from nerfro.cli.overrides import SHORT_NAMES, full_key
from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR, refuse_root, user_path
from nerfro.core.trust import MAX_YAML_CHARACTERS, GuardedConfigLoader, require_bounded_yaml
from nerfro.registry.allowed import MissingSettingError, hints_of, plain, require_names, set_types, validate
from nerfro.registry.registration import discover

Expand = Callable[[Sequence[str], Sequence[str]], list[str]]
SWEEP = "hydra.mode=MULTIRUN"  # override of the configuration of a sweep and of its jobs


@dataclass(frozen=True)
class Composer:
    """Composition of the configuration of a command from groups.

    Attributes:
        command: name of the command, and of its YAML file in conf/.
        schema: dataclass of the root.
        check: further check of the configuration.
        expand: function that replaces arguments that stand for several settings; it also receives the names of the
            settings of the root.
        verbatim: keys whose values are texts that may contain commas and equals signs, which Hydra would parse.
        check_inputs: check of the data and the device, which `--cfg job` calls after printing the configuration.
    """

    command: str
    schema: type
    check: Callable[[DictConfig], None] | None = None
    expand: Expand | None = None
    verbatim: tuple[str, ...] = ()
    check_inputs: Callable[[DictConfig], None] | None = None

    def overrides(self, arguments: Sequence[str]) -> list[str]:
        """Write the arguments of a command line in the grammar of Hydra."""
        overrides = [quoted(full_key(argument), self.verbatim) for argument in arguments]
        if self.expand is not None:
            overrides = self.expand(overrides, list(hints_of(self.schema)))
        return [*map(added, overrides)] if self.command == "train" else overrides

    def checked(self, config: DictConfig) -> Any:
        """Check the configuration of a job, which gets the annotated types, and return its settings as a dataclass.

        Raises:
            NerfroError: a setting is unknown or missing, or its value is not allowed.
        """
        groups = [path.name for path in CONF_DIR.iterdir() if path.is_dir()]
        values = plain(config)
        require_names("", [*hints_of(self.schema), *groups], values)
        with missing_with_example(self.command):
            settings: Any = validate(self.schema, values)
            set_types(config, settings)
            if self.check is not None:
                self.check(config)
        return settings

    def check_printed(self, hydra: Hydra, part: str) -> str:
        """Check the data and the device if Hydra has printed the part `job`, and say what is not checked."""
        job = getattr(hydra.config_loader, "job", None)
        if self.check_inputs is None or job is None or part != "job":
            return "the data, the device and the memory"
        self.check_inputs(job)
        return "the pixels, the object and the memory"

    @contextlib.contextmanager
    def hydra(self, folders: Sequence[str] = ()) -> Iterator[Hydra]:
        """Prepare Hydra to compose configurations, which are checked.

        Args:
            folders: further folders of YAML files, which have precedence.
        """
        discover()
        store_schema(self.command, self.schema)
        SourcesRegistry.instance().types["file"] = BoundedFiles
        search_path = create_config_search_path(str(CONF_DIR))
        for folder in folders:
            path = f"file://{os.path.abspath(folder)}"
            search_path.prepend("command-line", path, SearchPathQuery(provider="schema"))
        version.setbase("1.3")  # jobs stay in the current directory
        hydra = Hydra(self.command, _ConfigLoader(self.checked, search_path))
        with global_hydra(hydra):
            yield hydra


@contextlib.contextmanager
def missing_with_example(command: str) -> Iterator[None]:
    """Show an example of the command if a required option is missing."""
    try:
        yield
    except (MissingMandatoryValue, MissingSettingError) as error:
        name = error.full_key if isinstance(error, MissingMandatoryValue) else error.name
        example = usage(command).partition("Examples:\n")[2].partition("\n")[0].strip()
        raise NerfroError(f"{name}=... is missing; for example: {example}") from error


def quoted(argument: str, keys: tuple[str, ...]) -> str:
    """Quote the value of an override if its key is one of `keys`, or if it is the path of a run of a sweep (`a=1`)."""
    key, _, value = argument.partition("=")
    is_path = "=" in value and re.fullmatch(r"[\w./+@%=-]+", value)
    is_unquoted = key in keys and set(",=") & set(value) and value[0] not in "\"'"
    return f"{key}='{value}'" if is_path or is_unquoted else argument


def added(argument: str) -> str:
    """Add Hydra's plus sign for additions to mappings, and for groups without a default (experiment=glass)."""
    key = argument.partition("=")[0]
    if key == "optimizer.groups":
        # Hydra reads names with dots inside of a mapping, such as `cameras.exposure`, without quotes.
        argument = argument.replace('"', "")
    if key.startswith(("optimizer.options.", "optimizer.scheduler_options.")):
        return f"++{argument}"
    mappings = ("optimizer.groups", "optimizer.options", "optimizer.scheduler_options")
    return f"+{argument}" if key in (*ADDED_GROUPS, *mappings) else argument


class _ConfigLoader(GuardedConfigLoader):
    """Composition of a configuration, also of each job of a sweep, with the checks of the command.

    Launchers hand the object to their workers.

    Attributes:
        job: the last checked configuration of a job, without interpolations.
    """

    job: DictConfig | None = None

    def __init__(self, check_job: Callable[[DictConfig], Any], config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self._check_job = check_job

    def load_configuration(
        self, config_name: str | None, overrides: list[str], run_mode: RunMode, *others: Any, **options: Any
    ) -> DictConfig:
        config = super().load_configuration(config_name, overrides, run_mode, *others, **options)
        folder = config.hydra.sweep._get_node("dir")._value()  # not resolved, as in ${now:%Y}
        if run_mode == RunMode.MULTIRUN and isinstance(folder, str):
            refuse_root(user_path(folder), "hydra.sweep.dir")
        return config

    def check(self, config: DictConfig) -> None:
        discover()  # the process may be a launcher's worker
        if config.hydra.mode == RunMode.MULTIRUN and SWEEP not in config.hydra.overrides.hydra:
            raise NerfroError("hydra.mode=MULTIRUN is not allowed here; start a sweep with the option -m")
        # Hydra adds the group `env`, and the options of plugins of other packages are theirs to check.
        _require_declared(config.hydra, "hydra.", ["env", "sweeper", "launcher"])
        job, hydra_config = copy.deepcopy(config), HydraConfig.instance()
        before = hydra_config.cfg
        try:
            hydra_config.set_config(job)  # for interpolations such as ${hydra:runtime.cwd}
            with flag_override(job.hydra, "readonly", False):
                # Stands for the folder of the job, which Hydra chooses later.
                job.hydra.runtime.output_dir = job.hydra.run.dir
            with flag_override(job, ["struct", "readonly"], False):
                del job["hydra"]
            set_types(config, self._check_job(job))
            OmegaConf.resolve(job)
            self.job = job
        finally:
            hydra_config.cfg = before

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """Compose the configuration of a job; its `hydra.job.override_dirname` names what differs between jobs."""
        overrides = [added(full_key(override)) for override in sweep_overrides]
        config = super().load_sweep_config(master_config, overrides)
        excluded = config.hydra.job.config.override_dirname.exclude_keys
        task = cast(list[str], OmegaConf.to_container(master_config.hydra.overrides.task, resolve=False))
        asked = OverridesParser.create().parse_overrides(task)
        # As sweepers write them: `debug=true` becomes `debug=True`.
        common = {f"{o.get_key_element()}={o.get_value_element_as_str()}" for o in asked if not o.is_sweep_override()}
        swept = (override.partition("=") for override in overrides if override not in common)
        parts = [f"-{key.lstrip('+').rpartition('.')[2]}={value}" for key, _, value in swept if key not in excluded]
        config.hydra.job.override_dirname = re.sub(r"[^\w.=+-]+", "_", "".join(parts)).rstrip("_")
        return config


def _require_declared(node: DictConfig, prefix: str, also: Sequence[str] = ()) -> None:
    """Refuse settings of Hydra that its dataclasses do not declare; `+` would add them.

    Args:
        node: the configuration of Hydra, or a node in it.
        prefix: full name of the node, with a dot at the end.
        also: further allowed names; nodes with these names are not checked.
    """
    schema = OmegaConf.get_type(node)
    if is_dataclass(schema):
        require_names(prefix, [*hints_of(schema), *also], node)
    for name, child in node.items_ex(resolve=False):
        if isinstance(child, DictConfig) and name not in also and not child._is_none():
            _require_declared(child, f"{prefix}{name!s}.")


class BoundedFiles(FileConfigSource):
    """Hydra's source of YAML files, with bounded size and short names of settings."""

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        if file.is_file() and not file.is_relative_to(CONF_DIR):
            try:
                with file.open(encoding="utf-8") as stream:
                    require_bounded_yaml(stream.read(MAX_YAML_CHARACTERS + 1), file)
            except UnicodeDecodeError as error:
                raise NerfroError(f"{file} is not a text in UTF-8; save it again with this encoding") from error
        result = super().load_config(config_path)
        group = config_path.rpartition("/")[0]
        package = result.header.get("package") or group.replace("/", ".")
        config = cast(DictConfig, result.config)
        for short, full in SHORT_NAMES.items():
            if package in ("", "_global_") and short in config:
                OmegaConf.update(config, full, config.pop(short), force_add=True)
        return result


BoundedFiles.__name__ = FileConfigSource.__name__  # Hydra allows one class for each scheme, and compares their names
