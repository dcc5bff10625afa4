"""Settings of a training that have no effect beside other settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_args, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from nerfro.allowed import OnlyWith
from nerfro.errors import NerfroError
from nerfro.registry import SEVERAL, Plugin, find, plugin_of


def require_effect(config: DictConfig, overrides: Iterable[str]) -> None:
    """Refuse given settings that have no effect beside the other settings, see `allowed.OnlyWith`.

    Settings that are off (null, 0 or false) or have the default value are accepted.

    Args:
        config: configuration of a run, see `TrainConfig`.
        overrides: settings of the command line.

    Raises:
        NerfroError: a setting has no effect.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        if not override.is_delete():
            for name in _leaves(tuple(override.get_key_element().lstrip("+").split(".")), override.value()):
                _require_effect_of(config, name)


def _leaves(name: tuple[str, ...], value: object) -> Iterator[tuple[str, ...]]:
    """Yield the full names of the settings in a value, which may be a mapping."""
    if not isinstance(value, Mapping):
        yield name
        return
    for key, each in value.items():
        yield from _leaves((*name, str(key)), each)


def _require_effect_of(config: DictConfig, full_name: tuple[str, ...]) -> None:
    *place, name = full_name
    node: Any = config
    for key in place:
        node = node[key] if isinstance(node, DictConfig) and key in node else None
    if not isinstance(node, DictConfig) or name not in node or not node[name]:
        return
    hints, defaults = _described(node, place)
    if node[name] == defaults.get(name):
        return
    for condition in get_args(hints.get(name)):
        if isinstance(condition, OnlyWith):
            _require(condition, config, node, place, name)


def _require(condition: OnlyWith, config: DictConfig, node: DictConfig, place: list[str], name: str) -> None:
    """Refuse a setting of a node if a condition does not hold."""
    other = ".".join([*place, condition.setting]) if condition.setting in node else condition.setting
    value = OmegaConf.select(config, other)
    if isinstance(value, DictConfig):
        plugin = plugin_of(value)
        other, shown, holds = plugin.kind, plugin.name, _fits(condition, plugin)
    else:
        shown = "null" if value is None else str(value)
        holds = value in condition.values if condition.values else bool(value)
    if not holds:
        advice = f"{other}={' or '.join(condition.values)}" if condition.values else f"another {other}"
        raise NerfroError(
            f"{'.'.join([*place, name])}={node[name]} has no effect with {other}={shown}; remove it, or choose {advice}"
        )


def _fits(condition: OnlyWith, plugin: Plugin) -> bool:
    if condition.attribute is not None:
        return bool(getattr(plugin.cls, condition.attribute))
    return any(issubclass(plugin.cls, find(plugin.kind, name).cls) for name in condition.values)


def _described(node: DictConfig, place: list[str]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the annotations and the defaults of the settings in a node; both are empty for other mappings."""
    schema = OmegaConf.get_type(node)
    if len(place) == 2 and place[0] in SEVERAL:
        plugin = find(*place)
    elif "_target_" in node and place != ["trainer"]:
        plugin = plugin_of(node)
    elif dataclasses.is_dataclass(schema):
        return get_type_hints(schema, include_extras=True), OmegaConf.structured(schema)
    else:
        return {}, {}
    return plugin.hints, {name: default for name, _, default in plugin.fields()}
