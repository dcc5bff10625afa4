"""Settings of a training that have no effect in combination with the other settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, get_args

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from nerfro.cli.calls import Composition
from nerfro.core.errors import warn
from nerfro.registry.allowed import OnlyWith, hints_of, schema_of, untyped
from nerfro.registry.registration import SEVERAL, Plugin, find, plugin_of
from nerfro.training.config import TrainConfig
from nerfro.training.settings import flat


def warn_without_effect(composition: Composition) -> None:
    """Warn of given settings that have no effect in combination with the other settings."""
    for line in settings_without_effect(composition.config, composition.overrides):
        warn(line)


def settings_without_effect(config: DictConfig, overrides: Iterable[str]) -> list[str]:
    """Describe given settings that have no effect in combination with the other settings, see `allowed.OnlyWith`.

    Such settings are not refused, because the same settings may be given to several trainings, as in a sweep. Settings
    that are off (null, 0 or false) or have the default value are left out.

    Args:
        config: configuration of a run, see `TrainConfig`.
        overrides: settings of the command line.

    Returns:
        A line about each setting without effect.
    """
    lines = []
    parser = OverridesParser.create()
    for text in overrides:
        with suppress(HydraException):  # a path that was inserted for a scene, and that Hydra cannot parse
            override = parser.parse_override(text)
            if not override.is_delete():
                for full_name in flat(override.value(), override.get_key_element().lstrip("+")):
                    lines += _reasons(config, full_name)
    return lines


def _reasons(config: DictConfig, full_name: str) -> list[str]:
    """Say why a setting has no effect; the result is empty if the setting has an effect."""
    *place, name = full_name.split(".")
    node: Any = config
    for key in place:
        node = node[key] if isinstance(node, DictConfig) and key in node else None
    if not isinstance(node, DictConfig) or name not in node or not node[name]:
        return []
    hints, defaults = _described(node, place)
    if node[name] == defaults.get(name):
        return []
    conditions = [condition for condition in get_args(hints.get(name)) if isinstance(condition, OnlyWith)]
    reasons = (_reason(condition, config, node, place, name) for condition in conditions)
    return [reason for reason in reasons if reason is not None]


def _reason(condition: OnlyWith, config: DictConfig, node: DictConfig, place: list[str], name: str) -> str | None:
    """Say why a condition of a setting does not hold; None if it holds."""
    other = ".".join([*place, condition.setting]) if condition.setting in node else condition.setting
    value = OmegaConf.select(config, other)
    if isinstance(value, DictConfig):
        plugin = plugin_of(value)
        other, shown, holds = plugin.kind, plugin.name, _fits(condition, plugin)
    else:
        shown = "null" if value is None else str(value)
        holds = value in condition.values if condition.values else bool(value)
    if holds:
        return None
    advice = f"choose {other}={' or '.join(condition.values)}" if condition.values else f"change {other}"
    return f"{'.'.join([*place, name])}={node[name]} has no effect with {other}={shown}; remove it, or {advice}"


def _fits(condition: OnlyWith, plugin: Plugin) -> bool:
    if condition.attribute is not None:
        return bool(getattr(plugin.cls, condition.attribute))
    return any(issubclass(plugin.cls, find(plugin.kind, name).cls) for name in condition.values)


def _described(node: DictConfig, place: list[str]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the annotations and the defaults of the settings in a node; both are empty for other mappings."""
    if len(place) == 2 and place[0] in SEVERAL:
        plugin = find(*place)
    elif "_target_" in node and place[0] not in ("logger", "trainer"):  # whose classes are those of Lightning
        plugin = plugin_of(node)
    else:
        schema: Any = TrainConfig
        for key in place:
            schema = None if schema is None else schema_of(hints_of(schema).get(key))
        return ({}, {}) if schema is None else (hints_of(schema), vars(untyped(schema())))
    return plugin.hints, plugin.node
