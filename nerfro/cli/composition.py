"""Composition of configurations by Hydra, with checks and limits for files."""

from __future__ import annotations

import contextlib
import copy
import functools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import hydra
import hydra._internal.hydra
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override

from nerfro.cli.overrides import SHORT_NAMES, full_key
from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR, refuse_root, user_path
from nerfro.core.trust import MAX_YAML_CHARACTERS, GuardedConfigLoader, require_bounded_yaml
from nerfro.registry.allowed import check_names
from nerfro.registry.registration import discover


@contextlib.contextmanager
def composed_with(check: Callable[[DictConfig], None]) -> Iterator[None]:
    """Let Hydra compose configurations with the checks of a command."""
    before = hydra._internal.hydra.ConfigLoaderImpl
    hydra._internal.hydra.ConfigLoaderImpl = functools.partial(_ConfigLoader, check)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        hydra._internal.hydra.ConfigLoaderImpl = before  # type: ignore[misc]


class _ConfigLoader(GuardedConfigLoader):
    """Composition of a configuration, also of each job of a sweep, with the checks of the command.

    Launchers hand the object to their workers.
    """

    def __init__(self, check_job: Callable[[DictConfig], None], config_search_path: ConfigSearchPath) -> None:
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
        # Hydra adds the group `env`, and the options of plugins of other packages are theirs to check.
        check_names(config.hydra, "hydra.", also=["env", "sweeper", "launcher"])
        job, hydra_config = copy.deepcopy(config), HydraConfig.instance()
        before = hydra_config.cfg
        try:
            hydra_config.set_config(job)  # for interpolations such as ${hydra:runtime.cwd}
            with flag_override(job.hydra, "readonly", False):
                # Stands for the folder of the job, which Hydra chooses later.
                job.hydra.runtime.output_dir = job.hydra.run.dir
            with flag_override(job, ["struct", "readonly"], False):
                del job["hydra"]
            self._check_job(job)
        finally:
            hydra_config.cfg = before

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """Compose the configuration of a job; its `hydra.job.override_dirname` names what differs between jobs."""
        overrides = [full_key(override) for override in sweep_overrides]
        config = super().load_sweep_config(master_config, overrides)
        excluded = config.hydra.job.config.override_dirname.exclude_keys
        task = cast(list[str], OmegaConf.to_container(master_config.hydra.overrides.task, resolve=False))
        given = OverridesParser.create().parse_overrides(task)
        # As sweepers write them: `debug=true` becomes `debug=True`.
        common = {f"{o.get_key_element()}={o.get_value_element_as_str()}" for o in given if not o.is_sweep_override()}
        swept = (override.partition("=") for override in overrides if override not in common)
        parts = [f"-{key.lstrip('+').rpartition('.')[2]}={value}" for key, _, value in swept if key not in excluded]
        config.hydra.job.override_dirname = re.sub(r"[^\w.=+-]+", "_", "".join(parts)).rstrip("_")
        return config


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
