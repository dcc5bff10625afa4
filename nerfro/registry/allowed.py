"""Settings with annotated types, checked and converted by pydantic.

The limits of numbers are those of annotated-types, such as `Annotated[int, Ge(1), Le(8)]`. Numbers must be finite.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt
from omegaconf import MISSING, DictConfig, OmegaConf, flag_override
from pydantic import AllowInfNan, BeforeValidator, TypeAdapter, ValidationError

from nerfro.core.errors import NerfroError, nearest_of

Class = TypeVar("Class")
Settings = TypeVar("Settings")


@dataclass(frozen=True)
class Names:
    """Names to which plugins add, such as those of exports; the help of a command lists the names.

    Attributes:
        of: returns the names.
    """

    of: Callable[[], Iterable[str]]


class Refused(str):
    """Reason why a setting has no meaning, and what to use instead."""

    def refuse(self, value: object) -> None:
        """Refuse all values but None, which leaves the setting out."""
        if value is not None:
            raise ValueError(str(self))


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


FURTHEST = 10**7  # world units, as in georeferenced data

Count = Annotated[int, Ge(1)]
NumRays = Annotated[int, Ge(1), Le(2**22)]  # computed in one chunk
Side = Annotated[int, Ge(1), Le(32)]  # number of rays along each side of a pixel
Depth = Annotated[int, Ge(1), Le(64)]  # number of layers, levels or octaves
Width = Annotated[int, Ge(1), Le(2**13)]  # of layers
Resolution = Annotated[int, Ge(4), Le(2048)]  # vertices along each side of a grid
Natural = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Factor = Annotated[float, Ge(1)]
Share = Annotated[float, Gt(0), Lt(1)]
Coordinate = Annotated[float, Ge(-FURTHEST), Le(FURTHEST)]  # world units
Distance = Annotated[float, Ge(0), Le(FURTHEST)]  # world units

_TEXT = "float_parsing"  # type of pydantic's errors about text instead of a number
_LONGEST = 100  # characters of a value in a message
_BEYOND_LIMITS = ("greater_than_equal", "greater_than", "less_than_equal", "less_than")  # types of pydantic's errors
_WORDS = {Ge: ("at least", "ge"), Gt: ("more than", "gt"), Le: ("at most", "le"), Lt: ("less than", "lt")}


def convert(where: str, hints: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Check settings against annotations, and convert them to the annotated types; digits are numbers, too.

    Args:
        where: start of the error message.
        hints: annotations by name, including `Annotated`; values without a setting's annotation are returned as is.
        values: values by name.

    Raises:
        NerfroError: a value is not allowed; the message names the value and the allowed ones.
    """
    converted = {}
    for name, value in values.items():
        adapter = _adapter(hints.get(name))
        try:
            converted[name] = value if adapter is None else adapter.validate_python(value)
        except ValidationError as error:
            raise _not_allowed(where, name, value, _advice(hints[name], error.errors()[0])) from None
    return converted


def check(where: str, hints: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Check values of a file against annotations, like `convert`; text is no number, and None is always allowed."""
    present = {name: value for name, value in values.items() if value is not None}
    for name, value in convert(where, hints, present).items():
        if value != present[name]:
            raise _not_allowed(
                where,
                name,
                present[name],
                _advice(hints[name], {"type": _TEXT if isinstance(present[name], str) else "", "loc": (0,)}),
            )


def _not_allowed(where: str, name: str, value: object, advice: str) -> NerfroError:
    shown = repr(value) if len(repr(value)) < _LONGEST else f"{repr(value)[:_LONGEST]}..."
    return NerfroError(f"{where}{name}={shown} is not allowed; {advice}")


def validate(schema: type[Settings], values: object, prefix: str = "", complete: bool = True) -> Settings:
    """Check the values of the settings in a dataclass and in nested dataclasses, and return the dataclass.

    Args:
        schema: the dataclass.
        values: mapping with the values; the others have their defaults.
        prefix: full name of the node, with a dot at the end.
        complete: whether to refuse missing settings of the node.

    Raises:
        NerfroError: a setting is unknown or missing, or its value is not allowed.
    """
    if dataclasses.is_dataclass(values):
        return cast(Any, values)
    if not isinstance(values, Mapping):
        raise NerfroError(f"{prefix[:-1]}={values} is not a set of settings; write {prefix}NAME=VALUE")
    hints, fields = hints_of(cast(Any, schema)), {field.name: field for field in dataclasses.fields(cast(Any, schema))}
    require_names(prefix, fields, values)
    own = {str(name): value for name, value in values.items() if not is_missing(value)}
    for name, field in fields.items():
        if complete and name not in own and is_missing(default_of(field)):
            raise MissingSettingError(f"{prefix}{name}")
        nested = schema_of(hints[name])
        if nested is None or name not in own or isinstance(own[name], nested):
            continue
        if dataclasses.is_dataclass(hints[name]):
            own[name] = validate(nested, own[name], f"{prefix}{name}.", complete)
        elif isinstance(own[name], Mapping):
            nodes = own[name].items()
            own[name] = {key: validate(nested, node, f"{prefix}{name}.{key}.", complete) for key, node in nodes}
    return schema(**convert(prefix, hints, own))


class MissingSettingError(NerfroError):
    """A required setting without a value."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name}=... is missing")
        self.name = name


def require_names(prefix: str, names: Iterable[str], values: Iterable[object]) -> None:
    """Refuse the first unknown name of a setting, and suggest the most similar one.

    Raises:
        NerfroError: a name is unknown.
    """
    allowed_names = [*names]
    for name in map(str, values):
        if name not in allowed_names:
            raise NerfroError(f"{prefix}{name} is not a setting; {nearest_of(name, allowed_names)}")


@functools.cache
def hints_of(schema: Any) -> dict[str, Any]:
    """Return the annotations of a dataclass or function by name, including `Annotated`."""
    return get_type_hints(schema, include_extras=True)


def schema_of(hint: Any) -> Any:
    """Return the dataclass of a nested node, or of each node of a mapping; None for other settings."""
    inner = [arg for arg in get_args(hint) if arg is not type(None)]
    hint = inner[1] if get_origin(hint) is dict else hint
    return hint if dataclasses.is_dataclass(hint) else None


def validated(where: str) -> Callable[[Class], Class]:
    """Decorate a class or a function so that its constructor or call checks and converts all settings among arguments.

    Args:
        where: start of the error message, such as `medium=vacuum`.
    """

    def guarded(function: Any) -> Any:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            bound = signature.bind(*arguments, **named)
            bound.arguments.update(convert(f"{where}: ", hints_of(function), bound.arguments))
            return function(*bound.args, **bound.kwargs)

        return call

    def wrap(cls: Class) -> Class:
        if not isinstance(cls, type):
            return guarded(cls)
        cls.__init__ = guarded(cls.__init__)  # type: ignore[misc]
        return cls

    return wrap


def setting_type(hint: Any) -> Any:
    """Convert an annotation to the type by which pydantic validates a setting; None if it is no setting.

    Settings are int, float, bool, str, `Literal`, their unions, list and dict forms, and all of these `Annotated`.
    """
    origin, args = get_origin(hint), get_args(hint)
    if hint in (int, float, str):
        return setting_type(Annotated[hint, None])
    if hint is bool or origin is Literal:
        return hint
    if origin is Annotated:
        limits = [BeforeValidator(limit.refuse) if isinstance(limit, Refused) else limit for limit in args[1:]]
        if args[0] is float:
            limits.append(AllowInfNan(False))
        if args[0] in _CONVERSIONS:
            limits.append(BeforeValidator(_CONVERSIONS[args[0]]))
        inner = args[0] if args[0] in (Any, *_CONVERSIONS) else setting_type(args[0])
        arguments = (inner, *limits)
        return None if inner is None else Annotated[arguments]
    if origin in (Union, types.UnionType):
        members = tuple(arg if arg is type(None) else setting_type(arg) for arg in args)
        return None if None in members else Union[members]  # noqa: UP007 - for a variable
    if origin in (list, tuple, Sequence):
        element = Any if args[0] is Any else setting_type(args[0])
        if element is None:
            return None
        return Annotated[tuple[element, ...] if origin is tuple else origin[element], BeforeValidator(_listed)]
    value_type: Any = (setting_type(args[1]) if origin is dict else None) or Any
    return dict[str, value_type] if dict in (hint, origin) else None


@functools.cache
def _adapter(hint: Any) -> TypeAdapter | None:
    kind = setting_type(hint)
    return None if kind is None else TypeAdapter(kind)


def _integer(value: Any) -> Any:
    if isinstance(value, bool) or type(value).__name__.startswith("float"):  # those of NumPy, too
        raise ValueError("no integer")
    return value


def _listed(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def _number(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("no number")
    return value


def _text(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return str(value) if isinstance(value, int | float) else value


_CONVERSIONS = {int: _integer, float: _number, str: _text}  # before pydantic validates a value


def _without_none(args: Sequence[Any]) -> Any:
    return next(arg for arg in args if arg is not type(None))


def _advice(hint: Any, error: Mapping[str, Any]) -> str:
    """Say which values a setting may have.

    Args:
        hint: annotation of the setting.
        error: an error of pydantic: its type, the position in a list, and the exception of a validator.
    """
    inner, limits, choices = _parts(hint)
    if error["type"] == "value_error" and any(isinstance(mark, Refused) for mark in get_args(hint)):
        return str(error["ctx"]["error"])
    if choices:
        return f"choose {', '.join(map(repr, choices))}"
    if get_origin(inner) in (list, tuple, Sequence):
        return _advice(get_args(inner)[0], {**error, "loc": error["loc"][1:]}) if error["loc"] else "take a list"
    if error["type"] in (_TEXT, "int_parsing"):
        return "take a number, not text"
    names = {int: "an integer", float: "a finite number", str: "text", bool: "true or false"}
    return (
        f"take {limits}"
        if error["type"] in _BEYOND_LIMITS
        else ", ".join(filter(None, [f"take {names.get(inner, 'a mapping')}", limits]))
    )


def _parts(hint: Any) -> tuple[Any, str, tuple[Any, ...]]:
    """Return the type of a setting without `Optional` and `Annotated`, its limits in words, and the choices."""
    limits, choices = [], ()
    while get_origin(hint) in (Annotated, Union, types.UnionType):
        if get_origin(hint) is Annotated:
            known = ((_WORDS[type(limit)], limit) for limit in hint.__metadata__ if type(limit) in _WORDS)
            limits += [f"{words} {getattr(limit, name)}" for (words, name), limit in known]
            hint = hint.__origin__
        else:
            hint = _without_none(get_args(hint))
    if get_origin(hint) is Literal:
        choices = get_args(hint)
    return hint, " and ".join(limits), choices


def type_name(hint: Any) -> str:
    """Describe a type and its allowed values, in Markdown."""
    inner, limits, choices = _parts(hint)
    marks = [mark for level in (hint, *get_args(hint)[:1]) for mark in get_args(level) if isinstance(mark, Names)]
    names = [name for mark in marks for name in mark.of()] or choices
    if names:
        text = ", ".join(f"`{name}`" for name in names)
    elif get_origin(inner) in (list, tuple, Sequence):
        text = f"list of {type_name(get_args(inner)[0])}"
    elif dict in (inner, get_origin(inner)):
        text = "mapping"
    else:
        text = ", ".join(["any" if inner is Any else inner.__name__, *([limits] if limits else [])])
    is_optional = any(type(None) in get_args(level) for level in (hint, *get_args(hint)[:1]))
    return f"{text}; or null" if is_optional else text


def refuse_unused(settings: Any, names: Iterable[str], reason: str) -> None:
    """Refuse settings that are neither off (null, 0, false or empty) nor at their defaults, but have no effect.

    Args:
        settings: dataclass with the settings.
        names: names of the settings without effect.
        reason: end of the sentence "NAME=VALUE has no effect".

    Raises:
        NerfroError: a setting has such a value.
    """
    fields = {field.name: field for field in dataclasses.fields(settings)}
    for name in names:
        value = getattr(settings, name)
        if value and value != default_of(fields[name]):
            raise NerfroError(f"{name}={value} has no effect {reason}; remove it")


def default_of(field: dataclasses.Field) -> Any:
    """Return the default of a field of a dataclass; `MISSING` of OmegaConf for none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return MISSING if field.default is dataclasses.MISSING else field.default


def is_missing(value: object) -> bool:
    """Test whether a value stands for a required setting that is not set."""
    return isinstance(value, str) and value == MISSING


def plain(node: Any) -> dict[str, Any]:
    """Convert a node of a configuration to a mapping without interpolations."""
    return cast(dict, OmegaConf.to_container(node, resolve=True)) if isinstance(node, DictConfig) else dict(node)


def set_types(config: DictConfig, settings: Any) -> None:
    """Give settings of a configuration the types of a checked dataclass, such as False in place of the text `off`."""
    with flag_override(config, ["struct", "readonly"], False):
        _set_types(config, vars(settings))


def _set_types(node: DictConfig, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if name not in node or node[name] is None:
            continue
        if dataclasses.is_dataclass(value):
            _set_types(node[name], vars(value))
        elif isinstance(value, dict) and any(map(dataclasses.is_dataclass, value.values())):
            _set_types(node[name], value)
        elif isinstance(value, bool | int | float | str) and type(node[name]) is not type(value):
            node[name] = value
        elif isinstance(value, list | tuple) and [*map(type, node[name])] != [*map(type, value)]:
            node[name] = list(value)


def untyped(settings: Any) -> Any:
    """Copy a dataclass to one with the same names and values, whose types OmegaConf does not check."""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    values = {name: untyped(value) if dataclasses.is_dataclass(value) else value for name, value in values.items()}
    values = {name: _without_classes(value) if isinstance(value, dict) else value for name, value in values.items()}
    kinds = {name: type(value) if dataclasses.is_dataclass(value) else Any for name, value in values.items()}
    return dataclasses.make_dataclass(type(settings).__name__, kinds.items())(**values)


def _without_classes(values: dict[str, Any]) -> dict[str, Any]:
    """Replace dataclasses in a dictionary by their fields."""
    return {
        name: dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value  # type: ignore[arg-type]
        for name, value in values.items()
    }
