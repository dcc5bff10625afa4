"""Registry of plugins; the constructor of a plugin class defines the configuration schema.

`@register(kind, name)` reads the settings from the signature of the constructor and stores their defaults in Hydra as
option `name` of group `kind`. Only `build(node)` instantiates classes from a configuration, and only registered
ones.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import os
import pkgutil
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import InstantiationException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.utils import get_class, instantiate
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfro.core.errors import NerfroError
from nerfro.core.paths import PLUGINS_DIR, PLUGINS_PACKAGE
from nerfro.registry.allowed import (
    convert,
    hints_of,
    is_missing,
    plain,
    require_names,
    setting_type,
    type_name,
    validated,
)

KINDS = (
    "model", "camera", "medium", "surface", "sampler/path", "sampler/points", "field", "background", "loss", "phase",
    "data", "callbacks", "metric",
)  # fmt: skip

SEVERAL = ("loss", "phase", "callbacks")  # a run may have several plugins of these types

# Modules and packages with built-in plugins; `discover` imports all of them.
_BUILT_IN = (
    "camera", "camera.refined", "media", "samplers.paths", "samplers.points", "fields", "backgrounds",
    "losses", "models", "paper", "data.formats", "evaluation.image_metrics", "evaluation.perceptual",
    "training.lightning_callbacks", "training.phases", "viewing.page", "exports",
)  # fmt: skip
ENTRY_POINTS = "nerfro.plugins"

# Objects of Lightning that a configuration may name as Hydra's `_target_`, beside registered classes.
_LIGHTNING_TARGETS = frozenset(
    "lightning.pytorch." + name
    for name in (
        "Trainer",
        "loggers.TensorBoardLogger",
        "loggers.CSVLogger",
        "loggers.WandbLogger",
        "loggers.MLFlowLogger",
        "loggers.CometLogger",
        "strategies.DDPStrategy",
    )
)

Part = TypeVar("Part")


@dataclass(frozen=True)
class Plugin:
    """A registered class and its settings.

    Attributes:
        kind: plugin type and configuration group, such as `sampler/path`.
        name: name of the option in the group, such as `eikonal`.
        cls: the class, or a function that returns an instance.
        hints: annotations of the settings, see `nerfro.registry.allowed`.
        defaults: defaults of the settings; `MISSING` for required ones.
        parts: other constructor parameters; the caller of `build` passes the values.
    """

    kind: str
    name: str
    cls: Any
    hints: Mapping[str, Any]
    defaults: Mapping[str, Any]
    parts: frozenset[str]

    @property
    def target(self) -> str:
        return f"{self.cls.__module__}.{self.cls.__qualname__}"

    @property
    def summary(self) -> str:
        """First line of the docstring of the class."""
        return (inspect.getdoc(self.cls) or "").split("\n", 1)[0]

    @property
    def node(self) -> dict[str, Any]:
        """Node of a configuration with the defaults."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in self.defaults.items()} | {
            "_target_": self.target
        }

    @property
    def prefix(self) -> str:
        """Full name of the node in a configuration, with a dot at the end."""
        return f"{self.kind.replace('/', '.')}." + f"{self.name}." * (self.kind in SEVERAL)

    def fields(self) -> Iterator[tuple[str, str, object]]:
        """Yield the name, type and default of each setting."""
        node = self.node
        for name, hint in self.hints.items():
            yield name, type_name(hint), "required" if is_missing(node[name]) else node[name]


_plugins: dict[tuple[str, str], Plugin] = {}
# Checks of classes that register, by plugin type; each takes the name and the class, and raises NerfroError.
CHECKS: dict[str, Callable[[str, type], None]] = {}
_discovered: set[str] = set()


def register(kind: str, name: str) -> Callable[[Part], Part]:
    """Register a class, or a function that returns an instance, as option `name` of a plugin type.

    The signature of the constructor or function becomes the configuration. Parameters annotated with int, float, bool,
    str, their optional, list and dict forms or `Literal` are configuration. The caller of `build` passes all other
    parameters. Values outside the annotated ranges are refused (`nerfro.registry.allowed`).

    Args:
        kind: plugin type, one of `KINDS`.
        name: name of the option.

    Raises:
        NerfroError: the plugin type is unknown, the name is taken, or the class lacks a part of its contract.
    """

    def wrap(cls: Part) -> Part:
        check = validated(f"{kind}={name}")
        # The check replaces the constructor of a class, but cannot change a function in place.
        option = cls if isinstance(cls, type) else check(cls)
        add(kind, name, option)
        return check(cls) if isinstance(cls, type) else option

    return wrap


def add(kind: str, name: str, cls: Any) -> None:
    """Register a class of another package under a name; see `register`."""
    _require_kind(kind)
    taken = _plugins.get((kind, name))
    # A second import of a module registers the same class again.
    if taken is not None and (taken.cls.__module__, taken.cls.__qualname__) != (cls.__module__, cls.__qualname__):
        raise NerfroError(
            f"{kind}={name} is registered twice, by {taken.cls.__module__} and {cls.__module__}; rename one of them"
        )
    if kind in CHECKS:
        CHECKS[kind](name, cls)
    _plugins[kind, name] = plugin = _make_plugin(kind, name, cls)
    package = f"{kind}.{name}" if kind == "callbacks" else None  # a run may have several
    ConfigStore.instance().store(group=kind, name=name, node=plugin.node, package=package, provider="nerfro")


def plugins(kind: str | None = None) -> list[Plugin]:
    """Return the registered plugins, of one type or of all, sorted by type and name."""
    _require_kind(kind or KINDS[0])
    of_kind = (p for p in _plugins.values() if kind in (None, p.kind))
    return sorted(of_kind, key=lambda p: (KINDS.index(p.kind), p.name))


def find(kind: str, name: str) -> Plugin:
    """Return the plugin with a given type and name.

    Raises:
        NerfroError: no such plugin is registered.
    """
    if (kind, name) not in _plugins:
        names = ", ".join(p.name for p in plugins(kind))
        raise NerfroError(f"no {kind} is called '{name}'; known: {names}")
    return _plugins[kind, name]


def build(node: object, **parts: object) -> Any:
    """Instantiate the registered class (or Lightning object) of a configuration node.

    Args:
        node: configuration with `_target_`.
        parts: objects for the other constructor parameters; unused objects are ignored.

    Raises:
        NerfroError: the class is not registered, or the configuration does not fit the class.
    """
    node = _settings_of(node)
    target = node.get("_target_")
    if target in _LIGHTNING_TARGETS:
        try:
            require_lightning(node)
            own = inspect.signature(get_class(target)).parameters
            return instantiate(node, **{name: parts[name] for name in parts if name in own})
        except (InstantiationException, OmegaConfBaseException) as error:
            reason = str(error.__cause__ or error).strip().split("\n", 1)[0]
            if isinstance(error.__cause__, ImportError):
                raise NerfroError(f"{target} needs another package ({reason}); install it with pip") from error
            raise NerfroError(f"{target}: {reason}; check this object's fields in conf/") from error
    plugin = plugin_of(node)
    return create(plugin, node, **{name: parts[name] for name in plugin.parts if name in parts})


def check_node(node: object) -> Any:
    """Check the configuration node of a plugin, and return the class or function of the plugin.

    Raises:
        NerfroError: as `build`.
    """
    node = _settings_of(node)
    plugin = plugin_of(node)
    configure(plugin, node)
    return plugin.cls


def require_lightning(node: object) -> None:
    """Refuse a configuration node, such as a logger, if the class is neither registered nor an allowed Lightning class.

    Raises:
        NerfroError: the class is not allowed.
    """
    node = _settings_of(node)
    target = node.get("_target_")
    if target not in _LIGHTNING_TARGETS:
        plugin_of(node)
        return
    for nested in _targets(OmegaConf.to_container(node, resolve=True)):  # Hydra instantiates nested nodes too
        if nested not in _LIGHTNING_TARGETS:
            raise NerfroError(f"'{nested}' inside {target} is not registered; remove it")


def _settings_of(node: object) -> DictConfig:
    if not isinstance(node, Mapping):
        raise NerfroError(
            f"'{node}' is not a set of settings; choose an option with a slash, as in sampler/path=eikonal"
        )
    return node if isinstance(node, DictConfig) else OmegaConf.create(dict(node))


def plugin_of(node: DictConfig) -> Plugin:
    """Return the plugin that a configuration node names.

    Raises:
        NerfroError: the class is not registered.
    """
    target = str(node.get("_target_"))
    plugin = next((plugin for plugin in _plugins.values() if plugin.target == target), None)
    if plugin is None:
        if target.startswith("nerfro."):
            raise NerfroError(
                f"'{target}' is not registered in this version of nerfro; for a run of another version, install that "
                "version or train again"
            )
        raise NerfroError(
            f"'{target}' is not registered; `python -m nerfro.plugins` lists the registered classes; "
            "for a class in a local folder, set NERFRO_PLUGINS=DIR or start beside its plugins/"
        )
    return plugin


def create(plugin: Plugin, node: DictConfig | Mapping[str, object], **parts: object) -> Any:
    """Instantiate a plugin from its configuration node and other constructor arguments; the constructor checks both.

    Raises:
        NerfroError: a setting is unknown or missing, or its value is not allowed.
    """
    values = settings_of(plugin, node)
    attributes = {name: values.pop(name) for name in _attributes(plugin.cls) if name in values}
    attributes = convert(f"{plugin.kind}={plugin.name}: ", plugin.hints, attributes)
    made = plugin.cls(**values, **parts)
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def _attributes(cls: Any) -> tuple[str, ...]:
    """Names of configurable class attributes, such as the weight of a loss."""
    return getattr(cls, "SETTINGS", ())


def _require_kind(kind: str) -> None:
    if kind not in KINDS:
        raise NerfroError(f"'{kind}' is not a plugin type; choose one of {', '.join(KINDS)}")


def _targets(node: object) -> Iterator[object]:
    """Yield every `_target_` in a container, at any depth."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node["_target_"]
        for child in node.values():
            yield from _targets(child)
    elif isinstance(node, list):
        for child in node:
            yield from _targets(child)


def configure(plugin: Plugin, node: DictConfig | Mapping[str, object]) -> dict[str, Any]:
    """Check the configuration node of a plugin, and return the converted settings.

    Raises:
        NerfroError: a setting is unknown or missing, or its value is not allowed.
    """
    return convert(f"{plugin.kind}={plugin.name}: ", plugin.hints, settings_of(plugin, node))


def settings_of(plugin: Plugin, node: DictConfig | Mapping[str, object]) -> dict[str, Any]:
    """Return the given settings of a plugin, with known names.

    Raises:
        NerfroError: a setting is unknown, or a required one is missing.
    """
    values = {name: value for name, value in plain(node).items() if name != "_target_" and not is_missing(value)}
    require_names(plugin.prefix, plugin.hints, values)
    required = (name for name, default in plugin.defaults.items() if is_missing(default))
    missing = next((name for name in required if name not in values), None)
    if missing is not None:
        raise NerfroError(f"{plugin.kind}={plugin.name} needs {missing}; add {plugin.prefix}{missing}=...")
    return values


def discover(plugins_dir: Path = PLUGINS_DIR) -> None:
    """Import all built-in, installed and local plugin modules.

    Entry points of group `nerfro.plugins` name the installed plugins. Local plugins are the modules and packages in
    `plugins_dir` and in the folders of the environment variable `NERFRO_PLUGINS`, or in `plugins/` of the current
    directory without this variable.

    Args:
        plugins_dir: folder of local plugins; by default `plugins/` beside conf/.

    Raises:
        NerfroError: a plugin cannot be imported; the message names the file and the cause.
    """
    if not _discovered:
        for package in _BUILT_IN:
            _import_all(f"nerfro.{package}")
        for entry_point in importlib.metadata.entry_points(group=ENTRY_POINTS):
            _import_plugin(entry_point.value, f"'{entry_point.name}' of an installed package ({entry_point.value})")
        Plugins.instance().register(PluginConfigurations)
        _discovered.add("built-in")
    for folder in plugin_folders(plugins_dir):
        _import_folder(folder)


class PluginConfigurations(SearchPathPlugin):
    """Let Hydra search for options, such as experiments, in the folder `conf/` of each local plugin, too."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_folders():
            for configurations in sorted(folder.glob("*/conf")):
                search_path.append("nerfro", f"file://{configurations}")


def plugin_folders(plugins_dir: Path = PLUGINS_DIR) -> list[Path]:
    """Return the folders of local plugins; see `discover`."""
    folders = os.environ.get("NERFRO_PLUGINS")
    # A checkout of nerfro contains the plugins that an installed package already has.
    if folders is None and Path("plugins").is_dir() and not Path("nerfro").is_dir():
        folders = "plugins"
    return [plugins_dir.resolve(), *(Path(folder).resolve() for folder in (folders or "").split(os.pathsep) if folder)]


def _import_all(package: str) -> None:
    for module in pkgutil.iter_modules(getattr(importlib.import_module(package), "__path__", []), f"{package}."):
        importlib.import_module(module.name)


def _import_folder(folder: Path) -> None:
    if str(folder) in _discovered:
        return
    if not folder.is_dir():
        if folder == PLUGINS_DIR.resolve():  # a wheel may lack local plugins
            return
        raise NerfroError(f"plugin folder {folder} does not exist; correct NERFRO_PLUGINS")
    # A real parent package, so that `_target_` can be located by name.
    parent = sys.modules.get(PLUGINS_PACKAGE)
    if parent is None:
        parent = sys.modules[PLUGINS_PACKAGE] = types.ModuleType(PLUGINS_PACKAGE, "Parent of the local plugins.")
        parent.__path__ = []
    parent.__path__.append(str(folder))
    for module in pkgutil.iter_modules([str(folder)]):
        name = f"{PLUGINS_PACKAGE}.{module.name}"
        where = folder / (module.name if module.ispkg else f"{module.name}.py")
        loaded = sys.modules.get(name)  # possibly imported by another plugin of this folder
        if loaded is not None and Path(str(loaded.__file__)) not in (where, where / "__init__.py"):
            raise NerfroError(f"two plugin files are called {module.name}: {loaded.__file__} and {where}")
        _import_plugin(name, str(where))
    _discovered.add(str(folder))


def _import_plugin(module: str, where: str) -> None:
    try:
        importlib.import_module(module)
    except NerfroError as error:
        raise NerfroError(f"plugin {where}: {error}") from error
    except Exception as error:  # any error of a plugin's author; the message names the file
        raise NerfroError(f"plugin {where} cannot be imported: {type(error).__name__}: {error}") from error


def _make_plugin(kind: str, name: str, cls: Any) -> Plugin:
    hints, defaults, parts = {}, {}, set()
    for parameter, hint in _parameters(cls):
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise NerfroError(f"{kind}={name}: its constructor takes *{parameter.name}; name every parameter instead")
        if setting_type(hint) is None:
            parts.add(parameter.name)
        else:
            hints[parameter.name] = hint
            defaults[parameter.name] = MISSING if parameter.default is parameter.empty else parameter.default
    for attribute in _attributes(cls):
        hints[attribute] = hints_of(cls)[attribute]
        defaults[attribute] = getattr(cls, attribute)
    return Plugin(kind, name, cls, hints, defaults, frozenset(parts))


def _parameters(cls: Any) -> list[tuple[inspect.Parameter, Any]]:
    """Return the parameters of a constructor or function with their annotations.

    A constructor with `**options` also has the parameters of the base class constructor.
    """
    parameters: dict[str, tuple[inspect.Parameter, Any]] = {}
    if not isinstance(cls, type):
        return [(own, hints_of(cls).get(name)) for name, own in inspect.signature(cls).parameters.items()]
    for base in inspect.getmro(cls):
        # Classes without their own constructor have no configuration; the signature of nn.Module is generic. The class
        # is compared by name, because this module must not import torch.
        if base is object or f"{base.__module__}.{base.__name__}" == "torch.nn.modules.module.Module":
            break
        if "__init__" not in vars(base):
            continue
        constructor = inspect.unwrap(base.__init__)  # type: ignore[misc]
        _, *own = inspect.signature(constructor).parameters.values()
        for parameter in own:
            parameters.setdefault(parameter.name, (parameter, hints_of(constructor).get(parameter.name)))
        if not any(parameter.kind == parameter.VAR_KEYWORD for parameter in own):
            return [pair for pair in parameters.values() if pair[0].kind != inspect.Parameter.VAR_KEYWORD]
    return list(parameters.values())
