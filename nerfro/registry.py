"""The plugin registry: a class's constructor is its configuration.

`@register(kind, name)` reads the constructor's signature, makes a typed dataclass of it and stores that in Hydra as
option `name` of group `kind`. `build(node)` is the only place that instantiates, and only what is registered.
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

from hydra.core.config_store import ConfigStore
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn

from nerfro.allowed import check, checked
from nerfro.errors import NerfroError
from nerfro.paths import PLUGINS_DIR

KINDS = ("model", "camera", "medium", "sampler/path", "sampler/points", "field", "boundary", "loss", "data")

# Packages whose modules register the built-in parts, imported by `discover`.
_BUILT_IN = ("camera", "media", "samplers", "fields", "boundaries", "losses", "models", "data")
_LOCAL_PACKAGE = "nerfro_plugins"
_ENTRY_POINTS = "nerfro.plugins"

# Lightning's own objects are configured with Hydra's `_target_`; nothing else may be named there.
_LIGHTNING_TARGETS = frozenset(
    "lightning.pytorch." + name
    for name in (
        "Trainer",
        "loggers.TensorBoardLogger",
        "loggers.CSVLogger",
        "loggers.WandbLogger",
        "callbacks.ModelCheckpoint",
        "callbacks.LearningRateMonitor",
        "strategies.DDPStrategy",
    )
)

Part = TypeVar("Part")


@dataclass(frozen=True)
class Plugin:
    """A registered class and the configuration made of its constructor."""

    # Where it stands in the configuration, as in `sampler/path=eikonal`.
    kind: str
    name: str
    cls: type
    config: type  # dataclass of its configurable parameters, with `_target_`
    hints: Mapping[str, Any]  # annotations of the constructor's parameters, with what they allow (see `nerfro.allowed`)
    parts: frozenset[str]  # parameters that are not configuration; `build` is given them

    @property
    def target(self) -> str:
        return f"{self.cls.__module__}.{self.cls.__qualname__}"

    @property
    def summary(self) -> str:
        """First line of the docstring."""
        return (inspect.getdoc(self.cls) or "").split("\n", 1)[0]

    def fields(self) -> Iterator[tuple[str, str, object]]:
        """Name, type and default of each configurable parameter."""
        for field in dataclasses.fields(self.config):
            if field.name == "_target_":
                continue
            default = field.default_factory() if callable(field.default_factory) else field.default
            yield field.name, _type_name(self.hints[field.name]), "required" if default is MISSING else default


_plugins: dict[tuple[str, str], Plugin] = {}
_discovered: set[str] = set()


def register(kind: str, name: str) -> Callable[[type[Part]], type[Part]]:
    """Make a class available as option `name` of `kind`; its constructor's signature becomes its configuration.

    Parameters annotated with int, float, bool, str, their optional, list and dict forms or `Literal` are configuration;
    any other parameter is a part that `build` is given. What annotations do not allow is refused (`nerfro.allowed`).

    Raises:
        NerfroError: unknown kind, or the name is taken.
    """
    _require_kind(kind)

    def add(cls: type[Part]) -> type[Part]:
        taken = _plugins.get((kind, name))
        # The same class twice is a module imported again (a reload), not a clash.
        if taken is not None and (taken.cls.__module__, taken.cls.__qualname__) != (cls.__module__, cls.__qualname__):
            raise NerfroError(
                f"{kind}={name} is registered twice, by {taken.cls.__module__} and {cls.__module__}; rename one of them"
            )
        plugin = _make_plugin(kind, name, cls)
        _plugins[kind, name] = plugin
        ConfigStore.instance().store(group=kind, name=name, node=plugin.config, provider="nerfro")
        return checked(f"{kind}={name}")(cls)

    return add


def plugins(kind: str | None = None) -> list[Plugin]:
    """All registered plugins (of one kind), by kind and name."""
    if kind is not None:
        _require_kind(kind)
    chosen = (p for p in _plugins.values() if kind in (None, p.kind))
    return sorted(chosen, key=lambda p: (KINDS.index(p.kind), p.name))


def find(kind: str, name: str) -> Plugin:
    """The plugin registered as `name`."""
    if (kind, name) not in _plugins:
        known = ", ".join(p.name for p in plugins(kind))
        raise NerfroError(f"no {kind} is called '{name}'; known: {known}")
    return _plugins[kind, name]


def build(node: DictConfig | Mapping[str, object], **parts: object) -> Any:
    """Instantiate the registered class (or Lightning object) that a configuration node names.

    A class is given those of `parts` that it asks for.
    """
    if not isinstance(node, Mapping):
        raise NerfroError(
            f"'{node}' stands where settings belong; a slash chooses an option, as in sampler/path=eikonal"
        )
    node = node if isinstance(node, DictConfig) else OmegaConf.create(dict(node))
    target = node.get("_target_")
    if target in _LIGHTNING_TARGETS:
        try:
            # Hydra instantiates nested nodes too, whatever they name.
            for nested in _targets(OmegaConf.to_container(node, resolve=True)):
                if nested not in _LIGHTNING_TARGETS:
                    raise NerfroError(f"'{nested}' inside {target} is not registered, so it is not built; remove it")
            return instantiate(node, **parts)
        except (InstantiationException, OmegaConfBaseException) as error:
            cause = error.__cause__ or error
            raise NerfroError(f"{target}: {_first_line(cause)}; check this object's fields in conf/") from error
    plugin = next((p for p in _plugins.values() if p.target == target), None)
    if plugin is None:
        raise NerfroError(f"'{target}' is not registered, so it is not built; `python -m nerfro.plugins` lists what is")
    return plugin.cls(**configure(plugin, node), **{name: parts[name] for name in plugin.parts if name in parts})


def _require_kind(kind: str) -> None:
    if kind not in KINDS:
        raise NerfroError(f"'{kind}' is not a plugin kind; kinds: {', '.join(KINDS)}")


def _targets(node: object) -> Iterator[object]:
    """Every `_target_` in a container, at any depth."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node["_target_"]
        for child in node.values():
            yield from _targets(child)
    elif isinstance(node, list):
        for child in node:
            yield from _targets(child)


def configure(plugin: Plugin, node: DictConfig | Mapping[str, object]) -> dict[str, Any]:
    """Check a node against a plugin's configuration and return the constructor's arguments.

    Raises:
        NerfroError: a field is unknown, missing, of the wrong type or not an allowed choice.
    """
    where = f"{plugin.kind}={plugin.name}"
    try:
        # Resolved in its place first: a merged copy could not look its interpolations up.
        given = OmegaConf.to_container(node, resolve=True) if isinstance(node, DictConfig) else dict(node)
        merged = OmegaConf.merge(OmegaConf.structured(plugin.config), given)
        settled = OmegaConf.to_container(merged, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        known = ", ".join(name for name, _, _ in plugin.fields()) or "none"
        raise NerfroError(f"{where}: {_first_line(error)}; its fields: {known}") from error
    values = {str(key): value for key, value in typing.cast(dict, settled).items() if key != "_target_"}
    check(f"{where}: ", plugin.hints, values)
    return values


def discover(plugins_dir: Path = PLUGINS_DIR) -> None:
    """Import the built-in parts, then the local plugins, then the installed ones; importing registers them.

    Local plugins are the modules and packages of `plugins/` beside conf/ and of the folders in `NERFRO_PLUGINS`;
    installed ones are the modules that entry points of group `nerfro.plugins` name.

    Raises:
        NerfroError: a plugin cannot be imported; the file and the cause are named.
    """
    if not _discovered:
        for package in _BUILT_IN:
            _import_all(f"nerfro.{package}")
        for entry_point in importlib.metadata.entry_points(group=_ENTRY_POINTS):
            _import_plugin(entry_point.value, f"'{entry_point.name}' of an installed package ({entry_point.value})")
        _discovered.add("built-in")
    extra = os.environ.get("NERFRO_PLUGINS", "")
    for folder in (plugins_dir, *(Path(p) for p in extra.split(os.pathsep) if p)):
        _import_folder(folder.resolve())


def _import_all(package: str) -> None:
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        importlib.import_module(module.name)


def _import_folder(folder: Path) -> None:
    if str(folder) in _discovered:
        return
    if not folder.is_dir():
        if folder == PLUGINS_DIR.resolve():  # a wheel may come without local plugins
            return
        raise NerfroError(f"plugin folder {folder} does not exist; correct NERFRO_PLUGINS")
    # A real parent package, so that `_target_` can be located by name.
    parent = sys.modules.get(_LOCAL_PACKAGE)
    if parent is None:
        parent = sys.modules[_LOCAL_PACKAGE] = types.ModuleType(_LOCAL_PACKAGE, "Parent of the local plugins.")
        parent.__path__ = []
    parent.__path__.append(str(folder))
    for module in pkgutil.iter_modules([str(folder)]):
        name = f"{_LOCAL_PACKAGE}.{module.name}"
        where = folder / (module.name if module.ispkg else f"{module.name}.py")
        if name in sys.modules:
            raise NerfroError(f"two plugin files are called {module.name}: {sys.modules[name].__file__} and {where}")
        _import_plugin(name, str(where))
    _discovered.add(str(folder))


def _import_plugin(module: str, where: str) -> None:
    try:
        importlib.import_module(module)
    except NerfroError as error:
        raise NerfroError(f"plugin {where}: {error}") from error
    except Exception as error:  # whatever a plugin's author did wrong, its file is named
        raise NerfroError(f"plugin {where} cannot be imported: {type(error).__name__}: {error}") from error


def _make_plugin(kind: str, name: str, cls: type) -> Plugin:
    constructor = inspect.unwrap(cls.__init__)  # type: ignore[misc]
    hints = typing.get_type_hints(constructor)
    fields: list[tuple[str, Any, Any]] = []
    parts: set[str] = set()
    # Classes without a constructor of their own have no configuration; nn.Module's takes anything.
    own = constructor not in (object.__init__, nn.Module.__init__)
    for parameter in list(inspect.signature(constructor).parameters.values())[1:] if own else []:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise NerfroError(f"{kind}={name}: its constructor takes *{parameter.name}; name every parameter instead")
        hint = hints.get(parameter.name)
        config_type = _config_type(hint)
        if config_type is None:
            parts.add(parameter.name)
            continue
        fields.append((parameter.name, config_type, _default(parameter)))
    target = f"{cls.__module__}.{cls.__qualname__}"
    fields.append(("_target_", str, dataclasses.field(default=target)))
    config = dataclasses.make_dataclass(f"{cls.__name__}Config", fields, kw_only=True)
    allowing = typing.get_type_hints(constructor, include_extras=True)
    return Plugin(kind, name, cls, config, allowing, frozenset(parts))


def _config_type(hint: Any) -> Any:
    """The annotation as OmegaConf understands it, or None where it is not configuration."""
    if hint in (int, float, bool, str):
        return hint
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return type(args[0])
    if origin in (Union, types.UnionType) and type(None) in args and len(args) == 2:
        inner = _config_type(next(a for a in args if a is not type(None)))
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


def _type_name(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " | ".join(map(str, args))
    if origin is Annotated:
        return _type_name(args[0])
    if origin in (Union, types.UnionType):
        return " | ".join("none" if a is type(None) else _type_name(a) for a in args)
    if origin in (list, tuple, Sequence):
        return f"list[{_type_name(args[0])}]"
    name: str = getattr(origin or hint, "__name__", str(hint))
    return name


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n", 1)[0]
