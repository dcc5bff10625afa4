"""Allowed values of parameters and settings, declared by annotations such as `Annotated[int, Range(at_least=1)]`.

Numbers must be finite. Choices of text in configuration dataclasses have the
form `Annotated[str, Literal["a", "b"]]`, because OmegaConf does not support `Literal`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from nerfro.core.errors import NerfroError, nearest_of

Class = TypeVar("Class")


def _is_finite(number: object) -> bool:
    try:
        return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)
    except OverflowError:  # an integer of hundreds of digits
        return False


@dataclass(frozen=True)
class Range:
    """A range of finite numbers.

    Attributes:
        at_least, at_most: inclusive bounds; None for no bound.
        more_than, less_than: exclusive bounds; None for no bound.
    """

    at_least: float | None = None
    more_than: float | None = None
    at_most: float | None = None
    less_than: float | None = None

    def __contains__(self, number: Any) -> bool:
        return (
            _is_finite(number)
            and (self.at_least is None or number >= self.at_least)
            and (self.more_than is None or number > self.more_than)
            and (self.at_most is None or number <= self.at_most)
            and (self.less_than is None or number < self.less_than)
        )

    def __str__(self) -> str:
        ends = dataclasses.asdict(self).items()
        limits = " and ".join(f"{word.replace('_', ' ')} {end}" for word, end in ends if end is not None)
        return limits or "a finite number"


@dataclass(frozen=True)
class Names:
    """Names to which plugins add, such as those of exports; the help of a command lists the names.

    Attributes:
        of: returns the names.
    """

    of: Callable[[], Iterable[str]]


class Refused(str):
    """Reason why a setting has no meaning, and what to use instead."""


@dataclass(frozen=True)
class OnlyWith:
    """Condition without which a setting has no effect: the value of another setting.

    Attributes:
        setting: name of the other setting in the same component, or full name of a setting or a component.
        values: values with which the setting has an effect, or names of plugins; empty for all values except null, 0
            and false.
        attribute: attribute of the class of the other component that must be true, instead of `values`.
    """

    setting: str
    values: tuple[str, ...] = ()
    attribute: str | None = None


_FURTHEST = 10**7  # world units, as in georeferenced data

Count = Annotated[int, Range(at_least=1)]
NumRays = Annotated[int, Range(at_least=1, at_most=2**22)]  # computed in one chunk
Side = Annotated[int, Range(at_least=1, at_most=32)]  # number of rays along each side of a pixel
Depth = Annotated[int, Range(at_least=1, at_most=64)]  # number of layers, levels or octaves
Width = Annotated[int, Range(at_least=1, at_most=2**13)]  # of layers
Resolution = Annotated[int, Range(at_least=4, at_most=2048)]  # vertices along each side of a grid
Natural = Annotated[int, Range(at_least=0)]
Positive = Annotated[float, Range(more_than=0)]
NotNegative = Annotated[float, Range(at_least=0)]
Factor = Annotated[float, Range(at_least=1)]
Share = Annotated[float, Range(more_than=0, less_than=1)]
Coordinate = Annotated[float, Range(at_least=-_FURTHEST, at_most=_FURTHEST)]  # world units
Distance = Annotated[float, Range(at_least=0, at_most=_FURTHEST)]  # world units


def checked(where: str) -> Callable[[Class], Class]:
    """Decorate a class or a function so that its constructor or call checks all arguments against the annotations.

    Args:
        where: start of the error message, such as `medium=vacuum`.
    """

    def guarded(function: Any) -> Any:
        signature, hints = inspect.signature(function), get_type_hints(function, include_extras=True)

        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            check(f"{where}: ", hints, signature.bind(*arguments, **named).arguments)
            return function(*arguments, **named)

        return call

    def wrap(target: Class) -> Class:
        if not isinstance(target, type):
            return guarded(target)
        target.__init__ = guarded(target.__init__)  # type: ignore[misc]
        return target

    return wrap


def check_settings(config: DictConfig, schema: type, prefix: str = "") -> None:
    """Check the settings of a configuration, and of nested nodes, against the annotations of a dataclass.

    Args:
        config: the configuration.
        schema: dataclass with the annotations.
        prefix: full name of the node, with a dot at the end.

    Raises:
        NerfroError: a value is not allowed.
    """
    hints = get_type_hints(schema, include_extras=True)
    settings = {name: config[name] for name in hints if not OmegaConf.is_missing(config, name)}
    check(prefix, hints, settings)
    for name, value in settings.items():
        if dataclasses.is_dataclass(hints[name]):
            check_settings(value, hints[name], f"{prefix}{name}.")


def check_names(config: DictConfig, prefix: str = "", groups: Sequence[str] = (), also: Sequence[str] = ()) -> None:
    """Refuse settings without a field in the dataclass of the configuration or of a nested node.

    Hydra adds undeclared settings for overrides that begin with `+`.

    Args:
        config: the configuration.
        prefix: full name of the node, with a dot at the end.
        groups: names of configuration groups for suggestions in the error message.
        also: further allowed names at the root; nodes with these names are not checked.

    Raises:
        NerfroError: a name is unknown.
    """
    schema = OmegaConf.get_type(config)
    fields = None if not dataclasses.is_dataclass(schema) else [field.name for field in dataclasses.fields(schema)]
    for key, node in config.items_ex(resolve=False):
        name = str(key)
        if fields is not None and name not in (*fields, *also):
            raise NerfroError(f"{prefix}{name} is not a setting; {nearest_of(name, [*fields, *groups])}")
        if not isinstance(node, DictConfig) or name in also:
            continue
        if not (node._is_none() or node._is_missing() or node._is_interpolation()):
            check_names(node, f"{prefix}{name}.")


def check(where: str, hints: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Check values against annotations, and refuse the first forbidden value.

    Args:
        where: start of the error message.
        hints: annotations by name, including `Annotated`.
        values: values by name.

    Raises:
        NerfroError: a value is not allowed; the message names the value and the allowed ones.
    """
    for name, value in values.items():
        reason = _refusal(value, hints.get(name))
        if reason is not None:
            raise NerfroError(f"{where}{name}={value!r} is not allowed; {reason}")


def refuse_unused(options: object, names: Iterable[str], reason: str) -> None:
    """Refuse settings that are neither off (null, 0, false or empty) nor at their defaults, but have no effect.

    Args:
        options: a dataclass of options, or a configuration of its type.
        names: names of the settings without effect.
        reason: end of the sentence "NAME=VALUE has no effect".

    Raises:
        NerfroError: a setting has such a value.
    """
    settings = options if isinstance(options, DictConfig) else OmegaConf.structured(options)
    defaults = OmegaConf.structured(OmegaConf.get_type(settings))
    for name in names:
        if settings[name] and settings[name] != defaults[name]:
            raise NerfroError(f"{name}={settings[name]} has no effect {reason}; remove it")


def corners_of_box(box_min: Sequence[float], box_max: Sequence[float]) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box as an array.

    Args:
        box_min, box_max: lower and upper corner, world units.

    Raises:
        NerfroError: a corner does not have three numbers or is farther than 10^7 units from the origin, or the lower
            corner is not below the upper one.
    """
    box = np.array([box_min, box_max], np.float64) if len(box_min) == len(box_max) == 3 else np.zeros((2, 3))
    if not (box[1] > box[0]).all() or not (np.abs(box) <= _FURTHEST).all():
        raise NerfroError(
            f"box_min={list(box_min)}, box_max={list(box_max)} is not a box; give three numbers each, min below max, "
            f"and none beyond {_FURTHEST}"
        )
    return box


def _refusal(value: Any, hint: Any) -> str | None:
    origin, hints = get_origin(hint), get_args(hint)
    if value is None:
        return None
    if origin is Literal:
        return None if value in hints else f"choose {', '.join(map(repr, hints))}"
    if origin is Annotated and isinstance(hints[1], Refused):
        return str(hints[1])
    if origin is Annotated and isinstance(hints[1], OnlyWith):
        return _refusal(value, hints[0])
    has_range = origin is Annotated and isinstance(hints[1], Range)
    if (has_range or hint in (float, int)) and isinstance(value, str):  # the value of an interpolation may be text
        return "take a number, not text"
    if has_range:
        return f"take {hints[1]}" if value not in hints[1] else None
    if origin is Annotated:
        return _refusal(value, hints[1])
    if hint is str:
        return None if isinstance(value, (str, Path)) else "take text"
    if hint is float:
        return None if _is_finite(value) else "take a finite number"
    if origin in (list, Sequence) and isinstance(value, str):
        return "take a list"
    if origin in (list, tuple, Sequence) and isinstance(value, Sequence):
        return next((reason for each in value if (reason := _refusal(each, hints[0]))), None)
    if origin in (Union, types.UnionType):
        return next((reason for each in hints if (reason := _refusal(value, each))), None)
    return None
