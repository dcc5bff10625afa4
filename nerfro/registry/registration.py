"""Registry of plugins; the constructor of a plugin class defines the configuration schema.

`@register(kind, name)` converts the signature of the constructor to a typed dataclass and stores the dataclass in Hydra
as option `name` of group `kind`. Only `build(node)` instantiates classes from a configuration, and only registered
ones.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import os
import pkgutil
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Optional, TypeVar, Union, get_args, get_origin

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import InstantiationException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.utils import instantiate
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nerfro.core.errors import NerfroError
from nerfro.core.paths import PLUGINS_DIR, PLUGINS_PACKAGE
from nerfro.registry.allowed import Names, check

KINDS = (
    "model", "camera", "medium", "surface", "sampler/path", "sampler/points", "field", "background", "loss", "phase",
    "data", "callbacks", "metric",
)  # fmt: skip

SEVERAL = ("loss", "phase", "callbacks")  # a run may have several plugins of these types

# Modules and packages with built-in plugins; `discover` imports all of them.
_BUILT_IN = (
    "camera", "camera.refined", "media", "media.surfaces", "samplers.paths", "samplers.points", "fields", "backgrounds",
    "losses", "models", "paper", "data", "data.formats", "evaluation.image_metrics", "evaluation.perceptual",
    "training.phases", "viewing.page", "exports",
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
        "strategies.DDPStrategy",
    )
)

Part = TypeVar("Part")


@dataclass(frozen=True)
class Plugin:
    """A registered class and its configuration.

    Attributes:
        kind: plugin type and configuration group, such as `sampler/path`.
        name: name of the option in the group, such as `eikonal`.
        cls: the class.
        config: dataclass of the configurable parameters, with `_target_`.
        hints: annotations of the configurable parameters with allowed values, see `nerfro.registry.allowed`.
        parts: other constructor parameters; the caller of `build` passes the values.
    """

    kind: str
    name: str
    cls: type
    config: type
    hints: Mapping[str, Any]
    parts: frozenset[str]

    @property
    def target(self) -> str:
        return f"{self.cls.__module__}.{self.cls.__qualname__}"

    @property
    def summary(self) -> str:
        """First line of the docstring of the class."""
        return (inspect.getdoc(self.cls) or "").split("\n", 1)[0]

    @property
    def setting_names(self) -> list[str]:
        """Names of the settings of a configuration node, with `_target_`."""
        return [field.name for field in dataclasses.fields(self.config)]

    def fields(self) -> Iterator[tuple[str, str, object]]:
        """Yield the name, type and default of each configurable parameter."""
        for field in dataclasses.fields(self.config):
            if field.name == "_target_":
                continue
            default = field.default_factory() if callable(field.default_factory) else field.default
            yield field.name, type_name(self.hints[field.name]), "required" if default is MISSING else default


_plugins: dict[tuple[str, str], Plugin] = {}
# Checks of classes that register, by plugin type; each takes the name and the class, and raises NerfroError.
CHECKS: dict[str, Callable[[str, type], None]] = {}
_discovered: set[str] = set()


def register(kind: str, name: str) -> Callable[[type[Part]], type[Part]]:
    """Register a class as option `name` of a plugin type; used as a decorator.

    The signature of the constructor becomes the configuration. Parameters annotated with int, float, bool, str, their
    optional, list and dict forms or `Literal` are configuration. The caller of `build` passes all other parameters.
    Values outside the annotated ranges are refused (`nerfro.registry.allowed`).

    Args:
        kind: plugin type, one of `KINDS`.
        name: name of the option.

    Raises:
        NerfroError: the plugin type is unknown, the name is taken, or the class lacks a part of its contract.
    """
    _require_kind(kind)

    def wrap(cls: type[Part]) -> type[Part]:
        add(kind, name, cls)
        return checked(f"{kind}={name}")(cls)

    return wrap


def add(kind: str, name: str, cls: type) -> None:
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
    plugin = _make_plugin(kind, name, cls)
    _plugins[kind, name] = plugin
    package = f"{kind}.{name}" if kind == "callbacks" else None  # a run may have several
    ConfigStore.instance().store(group=kind, name=name, node=plugin.config, package=package, provider="nerfro")


def plugins(kind: str | None = None) -> list[Plugin]:
    """Return the registered plugins, of one type or of all, sorted by type and name."""
    _require_kind(kind or KINDS[0])
    chosen = (p for p in _plugins.values() if kind in (None, p.kind))
    return sorted(chosen, key=lambda p: (KINDS.index(p.kind), p.name))


def find(kind: str, name: str) -> Plugin:
    """Return the plugin with a given type and name.

    Raises:
        NerfroError: no such plugin is registered.
    """
    if (kind, name) not in _plugins:
        known = ", ".join(p.name for p in plugins(kind))
        raise NerfroError(f"no {kind} is called '{name}'; known: {known}")
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
            return instantiate(node, **parts)
        except (InstantiationException, OmegaConfBaseException) as error:
            cause = error.__cause__ or error
            raise NerfroError(f"{target}: {_first_line(cause)}; check this object's fields in conf/") from error
    plugin = plugin_of(node)
    return create(plugin, node, **{name: parts[name] for name in plugin.parts if name in parts})


def check_node(node: object) -> type:
    """Check the configuration node of a plugin, except for unresolved interpolations, and return the plugin class.

    Raises:
        NerfroError: as `build`.
    """
    node = _settings_of(node)
    plugin = plugin_of(node)
    keys = [str(key) for key in node]
    if not any(OmegaConf.is_interpolation(node, key) for key in keys):
        configure(plugin, node)
    else:
        unknown = [key for key in keys if OmegaConf.is_interpolation(node, key) or OmegaConf.is_missing(node, key)]
        known = {key: node[key] for key in keys if key not in unknown}
        check(f"{plugin.kind}={plugin.name}: ", plugin.hints, known)
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
        raise NerfroError(
            f"'{target}' is not registered; `python -m nerfro.plugins` lists the registered classes; "
            "for a class in a local folder, set NERFRO_PLUGINS=DIR or start beside its plugins/"
        )
    return plugin


def create(plugin: Plugin, node: DictConfig | Mapping[str, object], **parts: object) -> Any:
    """Instantiate a plugin from the configuration node and the other constructor arguments."""
    values = configure(plugin, node)
    attributes = {name: values.pop(name) for name in _settings(plugin.cls)}
    made = plugin.cls(**values, **parts)
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def _settings(cls: type) -> tuple[str, ...]:
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
    """Check the configuration node of a plugin and return the values of all configurable parameters.

    Raises:
        NerfroError: a parameter is unknown, missing, of the wrong type, or has a forbidden value.
    """
    where = f"{plugin.kind}={plugin.name}"
    try:
        # Resolved before merging, because interpolations of a merged copy would lose their parent nodes.
        given = OmegaConf.to_container(node, resolve=True) if isinstance(node, DictConfig) else dict(node)
        merged = OmegaConf.merge(OmegaConf.structured(plugin.config), given)
        settled = OmegaConf.to_container(merged, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        place = f"{plugin.kind.replace('/', '.')}.{f'{plugin.name}.' * (plugin.kind in SEVERAL)}{error.full_key}"
        raise NerfroError(f"{where} needs {error.full_key}; add {place}=...") from error
    except (OmegaConfBaseException, OverflowError) as error:  # the latter of integers with hundreds of digits
        known = ", ".join(name for name, _, _ in plugin.fields()) or "none"
        raise NerfroError(f"{where}: {_first_line(error)}; its fields: {known}") from error
    values = {str(key): value for key, value in typing.cast(dict, settled).items() if key != "_target_"}
    check(f"{where}: ", plugin.hints, values)
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


def _make_plugin(kind: str, name: str, cls: type) -> Plugin:
    fields: list[tuple[str, Any, Any]] = []
    parts: set[str] = set()
    allowing: dict[str, Any] = {}
    for parameter, hint, annotation in _parameters(cls):
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise NerfroError(f"{kind}={name}: its constructor takes *{parameter.name}; name every parameter instead")
        allowing[parameter.name] = annotation
        config_type = _config_type(hint)
        if config_type is None:
            parts.add(parameter.name)
        else:
            fields.append((parameter.name, config_type, _default(parameter)))
    if _settings(cls):
        annotations = typing.get_type_hints(cls, include_extras=True)
        for attribute in _settings(cls):
            allowing[attribute] = annotations[attribute]
            default = dataclasses.field(default=getattr(cls, attribute))
            fields.append((attribute, get_args(annotations[attribute])[0], default))
    target = f"{cls.__module__}.{cls.__qualname__}"
    fields.append(("_target_", str, dataclasses.field(default=target)))
    config = dataclasses.make_dataclass(f"{cls.__name__}Config", fields, kw_only=True)
    return Plugin(kind, name, cls, config, allowing, frozenset(parts))


def _parameters(cls: type) -> list[tuple[inspect.Parameter, Any, Any]]:
    """Return the parameters of a constructor with the types, without and with `Annotated`.

    A constructor with `**options` also has the parameters of the base class constructor.
    """
    found: dict[str, tuple[inspect.Parameter, Any, Any]] = {}
    for base in inspect.getmro(cls):
        # Classes without their own constructor have no configuration; the signature of nn.Module is generic. The class
        # is compared by name, because this module must not import torch.
        if base is object or f"{base.__module__}.{base.__name__}" == "torch.nn.modules.module.Module":
            break
        if "__init__" not in vars(base):
            continue
        constructor = inspect.unwrap(base.__init__)  # type: ignore[misc]
        hints, annotations = (typing.get_type_hints(constructor, include_extras=extras) for extras in (False, True))
        _, *parameters = inspect.signature(constructor).parameters.values()
        inherits = any(parameter.kind == parameter.VAR_KEYWORD for parameter in parameters)
        for parameter in parameters:
            found.setdefault(parameter.name, (parameter, hints.get(parameter.name), annotations.get(parameter.name)))
        if not inherits:
            return [given for given in found.values() if given[0].kind != given[0].VAR_KEYWORD]
    return list(found.values())


def _config_type(hint: Any) -> Any:
    """Convert an annotation to a type supported by OmegaConf; None if the parameter is not configurable."""
    if hint in (int, float, bool, str):
        return hint
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return type(args[0])
    if origin in (Union, types.UnionType) and type(None) in args and len(args) == 2:
        inner = _config_type(next(a for a in args if a is not type(None)))
        if get_origin(inner) is dict:  # OmegaConf cannot replace None by a mapping if it knows the type
            return Any
        return None if inner is None else Optional[inner]  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    if origin in (list, tuple, Sequence):
        element = next((a for a in args if a is not Ellipsis), Any)
        return list[element] if element is Any or _config_type(element) is not None else None
    if origin is dict:
        return dict[str, Any]
    return None


def _default(parameter: inspect.Parameter) -> Any:
    if parameter.default is parameter.empty:
        return dataclasses.field(default=MISSING)
    if isinstance(parameter.default, (list, tuple)):
        value = list(parameter.default)
        return dataclasses.field(default_factory=lambda: list(value))
    return dataclasses.field(default=parameter.default)


def type_name(hint: Any) -> str:
    """Describe a type and its allowed values, in Markdown."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in args)
    if origin is Annotated:
        limits = [str(limit) for limit in args[1:] if isinstance(limit, Range)]
        choices = [limit for limit in args[1:] if get_origin(limit) is Literal]
        names = [f"`{name}`" for limit in args[1:] if isinstance(limit, Names) for name in limit.of()]
        if names:
            return ", ".join(names)
        return type_name(choices[0]) if choices else ", ".join([type_name(args[0]), *limits])
    if type(None) in args:
        return "; ".join(type_name(arg) for arg in args if arg is not type(None)) + "; or null"
    if origin in (list, tuple, Sequence):
        return f"list of {type_name(args[0])}"
    if origin is dict:
        return "mapping"
    return "any" if hint is Any else getattr(hint, "__name__", str(hint))


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n", 1)[0]
