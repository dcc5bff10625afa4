"""Restriction of executed code to nerfro, Hydra, and registered plugins.

The command line, the folder `plugins/` and installed packages are trusted. Data, checkpoints, run folders, the current
directory, and configuration files of other people are not.
"""

from __future__ import annotations

import math
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig
from omegaconf.errors import OmegaConfBaseException

from nerfro.core.errors import NerfroError
from nerfro.core.paths import PACKAGE_DIR

# Classes that the node `hydra` of a configuration may name, beside the installed plugins of Hydra. The module `logging`
# takes factories from `()` and `class`.
_TARGETS = re.compile(r"hydra\.experimental\.callbacks\.\w+|optuna\.samplers\.\w+Sampler")
_HANDLERS = ("logging.", "colorlog.")
MAX_YAML_NODES = 100_000  # values of a YAML document, after aliases are replaced
MAX_YAML_CHARACTERS = 2**18
_STREAMS = ("ext://sys.stdout", "ext://sys.stderr")


def leave_current_directory() -> None:
    """Remove the current directory from the module search path, where `python -m` inserts the directory first.

    Hydra imports every module of a folder `hydra_plugins` on the search path, and the current directory may be a
    downloaded data set. The directory stays if nerfro itself is imported from the directory.
    """
    here = Path.cwd().resolve()
    if here != PACKAGE_DIR.parent.resolve():
        sys.path[:] = [place for place in sys.path if Path(place).resolve() != here]


class GuardedConfigLoader(ConfigLoaderImpl):
    """Hydra's configuration loader with a check that refuses foreign classes before Hydra instantiates any class.

    Hydra builds callbacks, launcher, sweeper and log handlers from the node `hydra` of any YAML file.
    """

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        config = super().load_configuration(config_name, overrides, run_mode, from_shell, validate_sweep_overrides)
        for key, value in _foreign(config.hydra, "hydra"):
            raise NerfroError(
                f"{key}={value} is not allowed; choose a launcher, sweeper or callback of Hydra by its name"
            )
        # Jobs of a sweep are composed one by one; the help of Hydra has no configuration of a job.
        if run_mode == RunMode.RUN and config_name is not None:
            self.check(config)
        return config

    def check(self, config: DictConfig) -> None:
        """Refuse unusable configurations of a job; the default accepts all configurations."""

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Hydra warns of a missing folder and continues
            parsed, repository = super()._parse_overrides_and_create_caching_repo(config_name, overrides)
        for source in repository.get_sources():
            if not source.available():
                raise NerfroError(f"{source.provider}: the configuration folder {source.path} does not exist")
        return parsed, repository


def _foreign(node: DictConfig | ListConfig, path: str) -> Iterator[tuple[str, object]]:
    """Yield keys and values that would execute code of other packages than Hydra."""
    keys = range(len(node)) if isinstance(node, ListConfig) else list(node)
    for key in keys:
        try:
            value = node[key]
        except OmegaConfBaseException:  # missing until the run begins
            value = node._get_node(key)._value()  # type: ignore[union-attr]
        where = f"{path}.{key}"
        if isinstance(value, DictConfig | ListConfig):
            yield from _foreign(value, where)
        elif value is not None and not _is_allowed(key, str(value)):
            yield where, value


def _is_allowed(key: object, value: str) -> bool:
    if key == "_target_":
        hydra_plugins = {f"{cls.__module__}.{cls.__name__}" for cls in Plugins.instance().discover()}
        return value in hydra_plugins or _TARGETS.fullmatch(value) is not None
    if key == "custom_search_space":  # a function that Optuna's sweeper would import and call
        return False
    if key in ("class", "()"):
        return value.startswith(_HANDLERS)
    return not value.startswith("ext://") or value in _STREAMS


def require_bounded_yaml(text: str, origin: Path) -> None:
    """Refuse a long YAML document, and one whose anchors expand to more than `MAX_YAML_NODES` nodes.

    Raises:
        NerfroError: the document is too large; syntax errors are left to the parser.
    """
    num_nodes: dict[int, float] = {}

    def count(node: yaml.Node) -> float:
        if id(node) not in num_nodes:
            num_nodes[id(node)] = math.inf  # of a node that contains itself
            children = node.value if isinstance(node, yaml.CollectionNode) else []
            pairs = (child if isinstance(child, tuple) else (child,) for child in children)
            num_nodes[id(node)] = 1 + sum(count(child) for pair in pairs for child in pair)
        return num_nodes[id(node)]

    try:
        too_large = len(text) > MAX_YAML_CHARACTERS
        root = None if too_large else yaml.compose(text, Loader=yaml.SafeLoader)
        too_large = too_large or (root is not None and count(root) > MAX_YAML_NODES)
    except yaml.YAMLError:
        return
    except RecursionError:
        too_large = True
    if too_large:
        raise NerfroError(f"{origin} is too long, nested too deeply or expands to too many values; shorten it")
