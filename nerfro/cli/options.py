"""Options of commands and plugins, described by their annotations and docstrings, and a cache of them.

The cache lets a command print its help, and refuse misspelt options, before it imports torch and Lightning.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import inspect
import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from hydra import compose, initialize_config_dir
from hydra._internal.hydra import Hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from nerfro.cli.overrides import full_key, is_scene_file
from nerfro.core.errors import NerfroError, nearest_of
from nerfro.core.paths import CONF_DIR, PACKAGE_DIR, cache_dir
from nerfro.registry.allowed import Refused, default_of, hints_of, is_missing, type_name, untyped
from nerfro.registry.registration import ENTRY_POINTS, KINDS, SEVERAL, Plugin, plugin_folders, plugins

# Groups without a default in conf/train.yaml.
ADDED_GROUPS = ("callbacks", "evaluation", "experiment", "scene", "sweep")
# Options that add a plugin of a type that a run, or a medium, may have several of.
_ADDED_PLUGINS = {
    "loss": "+loss.NAME.weight=0.1",
    "phase": "+phase.NAME={}",
    "surface": "+bodies.BODY.surface.name=NAME",
}


_HEADING, _TEXT = " " * 2, " " * 6  # indents of an option or a choice, and of the explanation below it


def laid_out(text: str, words: Sequence[str] = ()) -> str:
    """Fit the help to the width of the terminal, and select the options that contain all words.

    Raises:
        NerfroError: no option contains the words.
    """
    entries: list[list[str]] = []
    for line in text.splitlines():
        if line.startswith(_TEXT) and entries:
            entries[-1].append(line)
        else:
            entries.append([line])
    if words:
        options = [entry for entry in entries if re.match(rf"{_HEADING}\S", entry[0])]
        entries = [entry for entry in options if all(word.lower() in "\n".join(entry).lower() for word in words)]
        if not entries:
            raise NerfroError(f"no option contains {' and '.join(words)}; --help without words lists all options")
    # Longer lines are hard to read.
    width = min(max(shutil.get_terminal_size((100, 24)).columns, 40), 120)
    lines = []
    for line in (line for entry in entries for line in entry):
        indent = len(line) - len(line.lstrip())
        # Examples, which are indented by four, can be copied only if they are not wrapped.
        further = " " * (indent if indent != len(_HEADING) else 4)
        lines += [line] if indent == 4 else textwrap.wrap(line, width, subsequent_indent=further) or [""]
    return "\n".join(lines)


class Option(NamedTuple):
    """One option.

    Attributes:
        name: full name, such as `trainer.max_time`.
        type: type and allowed values, in Markdown.
        default: default value, or the text `required`.
        text: explanation.
    """

    name: str
    type: str
    default: object
    text: str

    def __str__(self) -> str:
        default = "null" if self.default is None else str(self.default)
        default = default.lower() if isinstance(self.default, bool) else default
        heading = f"  {self.name}={default}" + ("" if self.type == "any" else f"  ({self.type})")
        lines = [heading, *([f"{_TEXT}{' '.join(self.text.split())}"] if self.text else [])]
        return "\n".join(lines).replace("`", "")


@dataclasses.dataclass(frozen=True)
class Described:
    """Description of the options of a command.

    Attributes:
        help: text of `--help`.
        names: names of the settings in each node that has a fixed set of settings, by the full name of the node, and
            of the settings of each plugin, by texts such as `field=nerf`.
        choices: names of the options of each configuration group.
    """

    help: str
    names: Mapping[str, Sequence[str]]
    choices: Mapping[str, Sequence[str]]

    def answer(self, arguments: Sequence[str]) -> None:
        """Print the help and exit on request, or refuse misspelt names.

        Raises:
            NerfroError: a setting or an option does not exist.
        """
        if {"-h", "--help"} & {*arguments} and not ("hydra" in arguments and self.choices):
            words = [word for word in arguments if re.fullmatch(r"[\w./]+", word) and word != "hydra"]
            print(laid_out(self.help, words))
            sys.exit()
        # Other folders of configurations may have other groups.
        if not any(argument.startswith(("--config", "-c", "hydra.searchpath")) for argument in arguments):
            has_scene = bool({"data", "medium"} & {*self.names.get("", ())})
            self.require_known([full_key(text) for text in arguments if not (has_scene and is_scene_file(text))])

    def require_known(self, arguments: Sequence[str]) -> None:
        """Refuse the first override with a name that the command cannot know, whatever options are chosen.

        Raises:
            NerfroError: a setting or an option does not exist.
        """
        chosen = [text.lstrip("+").replace("/", ".") for text in arguments]
        plugins = {text.partition("=")[0]: text for text in chosen if "=" in text and text in self.names}
        for argument in arguments:
            key, equals, value = argument.lstrip("+~").partition("=")
            if not equals or not re.fullmatch(r"[\w./]+", key) or key.startswith("hydra"):
                continue
            if key == "metric" and self.names and key not in self.names.get("", ()):
                raise NerfroError(f"{argument}: all registered metrics are scored, so there is nothing to choose")
            if key in self.choices:
                if re.fullmatch(r"\w+", value) and value not in (*self.choices[key], "null"):
                    own = "; --config-dir FOLDER adds your experiments" if key == "experiment" else ""
                    raise NerfroError(f"{key}={value} does not exist; {nearest_of(value, self.choices[key])}{own}")
                continue
            if key in _ADDED_PLUGINS and re.fullmatch(r"\w+", value) and key in self.names.get("", ()):
                option = _ADDED_PLUGINS[key].replace("NAME", value)
                raise NerfroError(f"{argument}: a training may have several of this type; write {option}")
            if argument.startswith("+") and "." not in key:  # perhaps a group of another package
                continue
            parts = key.split(".")
            for depth, name in enumerate(parts):
                node = ".".join(parts[:depth])
                names = self.names.get(plugins.get(node, node))
                if names is None:
                    break
                if name not in names:
                    full_name = ".".join(parts[: depth + 1])
                    raise NerfroError(f"{full_name} is not a setting; {nearest_of(name, names)}")


def has_groups(command: str) -> bool:
    """Return whether Hydra composes the configuration of a command from groups and the YAML file of its name."""
    return (CONF_DIR / f"{command}.yaml").is_file()


def describe(command: str, schema: type) -> Described:
    """Describe the options of a command; its plugins must have been discovered.

    Args:
        command: name of the command.
        schema: dataclass of the options.
    """
    if not has_groups(command):
        return Described(_page(command, list(schema_options(schema, {})), {}), _names(schema), {})
    store_schema(command, schema)
    with global_hydra(None), initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        config = compose(command, return_hydra_config=True)
        groups = [kind for kind in KINDS if isinstance(OmegaConf.select(config, kind.replace("/", ".")), DictConfig)]
        groups = list(dict.fromkeys([*groups, "logger", *ADDED_GROUPS])) if command == "train" else groups
        loader = GlobalHydra.instance().config_loader()
        choices = {group: loader.get_group_options(group) for group in groups if group not in _ADDED_PLUGINS}
    kinds = [*groups, *(["surface"] if "medium" in groups else [])]
    added = {option: [p.name for p in plugins(kind)] for kind, option in _ADDED_PLUGINS.items() if kind in kinds}
    names = _names(schema)
    names[""] += [group.partition("/")[0] for group in groups]
    values = cast(dict[str, Any], OmegaConf.to_container(config))
    options = list(schema_options(schema, values))
    for kind in [group for group in groups if group in KINDS]:
        path, of_kind = kind.replace("/", "."), plugins(kind)
        nodes = {path: OmegaConf.select(config, path)}
        if kind in SEVERAL:
            nodes = {f"{path}.{name}": node for name, node in nodes[path].items()}
            names[path] = [plugin.name for plugin in of_kind]
            names |= {f"{path}.{plugin.name}": list(plugin.hints) for plugin in of_kind}
        else:
            names |= {f"{path}={plugin.name}": [*plugin.hints, "_target_"] for plugin in of_kind}
            names[path] = sorted({name for plugin in of_kind for name in names[f"{path}={plugin.name}"]})
        for prefix, node in nodes.items():
            plugin = next((plugin for plugin in of_kind if plugin.target == node.get("_target_")), None)
            node_values = cast(dict[str, Any], OmegaConf.to_container(node))
            options += [] if plugin is None else plugin_options(plugin, f"{prefix}.", node_values)
    selected = {group: f"{group}={config.hydra.runtime.choices.get(group, 'NAME')}" for group in choices}
    listed = {selected[group]: names for group, names in choices.items()} | added
    return Described(_page(command, options, listed), names, choices)


@contextlib.contextmanager
def global_hydra(hydra: Hydra | None) -> Iterator[None]:
    """Replace the Hydra of the process, of which there is only one, for example that of a running job."""
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().hydra = hydra
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = outer  # of an instance that `initialize_config_dir` may have replaced


def store_schema(command: str, schema: type) -> None:
    """Store the names and defaults of the settings of a command for Hydra."""
    ConfigStore.instance().store(name=f"{command}_schema", node=untyped(schema()), provider="nerfro")


def usage(command: str) -> str:
    """Return the purpose and the examples of a command, from the docstring of its module."""
    source = (PACKAGE_DIR / f"{command}.py").read_text(encoding="utf-8")
    first, _, examples = (ast.get_docstring(ast.parse(source)) or "").partition("\n")
    return f"{_sentence(first.rpartition('`: ')[2])}\n{examples}\n"


def _page(command: str, options: Sequence[Option], choices: Mapping[str, Sequence[str]]) -> str:
    lines = [usage(command), *(["Choices:"] if choices else [])]
    for choice, names in choices.items():
        lines.append(f"{_HEADING}{choice}  ({', '.join(names)})")
    lines += [""] if choices else []
    sections: dict[str, list[Option]] = {}
    for option in options:
        sections.setdefault(option.name.rpartition(".")[0].partition(".")[0], []).append(option)
    for section, members in sections.items():
        lines += [f"Options of {section}:" if section else "Options:", *map(str, members), ""]
    of_hydra = "`--help hydra` explains the flags of Hydra, such as -m for sweeps and --cfg job."
    lines.append(of_hydra if has_groups(command) else "`--cfg job` prints the options.")
    return "\n".join(lines).replace("`", "")


def schema_options(schema: Any, values: Mapping[str, Any], prefix: str = "") -> Iterator[Option]:
    """Yield the options of a configuration dataclass and of nested dataclasses.

    Args:
        schema: the dataclass.
        values: values that replace the defaults.
        prefix: full name of the node, with a dot at the end.
    """
    hints, explained = hints_of(schema), google_docstring(inspect.getdoc(schema) or "")[1]
    for field in dataclasses.fields(schema):
        hint, name, default = hints[field.name], prefix + field.name, default_of(field)
        if field.name.startswith("_") or any(isinstance(limit, Refused) for limit in get_args(hint)):
            continue
        default = values.get(field.name, default)
        if dataclasses.is_dataclass(hint):
            nested = default if isinstance(default, Mapping) else vars(default)
            yield from schema_options(hint, nested, f"{name}.")
            continue
        text = explained.get(field.name, "")
        if "_target_" in hints and not text:
            text = f"As in `{values.get('_target_')}`"
        if isinstance(default, Mapping) and default:
            if hint is Any:  # a component, whose options are those of its class
                continue
            default = ", ".join(default)
        yield Option(name, type_name(hint), "required" if is_missing(default) else default, _sentence(text))


def plugin_options(plugin: Plugin, prefix: str, values: Mapping[str, Any] | None = None) -> list[Option]:
    """Return the options of a plugin.

    Args:
        plugin: the plugin.
        prefix: full name of its node, with a dot at the end.
        values: values that replace the defaults.
    """
    explained: dict[str, str] = {}
    for base in getattr(plugin.cls, "__mro__", (plugin.cls,)):
        for documented in (vars(base).get("__init__"), base):
            explained = google_docstring(inspect.cleandoc(documented.__doc__ or ""))[1] | explained
    changed = {name: "required" if is_missing(value) else value for name, value in (values or {}).items()}
    return [
        Option(prefix + name, kind, changed.get(name, default), _sentence(explained.get(name, "")))
        for name, kind, default in plugin.fields()
    ]


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""


def google_docstring(docstring: str) -> tuple[str, dict[str, str]]:
    """Split a docstring into its text and the explanations of the sections Args and Attributes."""
    parts = re.split(r"^(Args|Attributes|Returns|Raises|Shape|Example[s]?|Note):\n", docstring, flags=re.MULTILINE)
    explained: dict[str, str] = {}
    for title, section in zip(parts[1::2], parts[2::2], strict=True):
        if title in ("Args", "Attributes"):
            for entry in re.split(r"\n(?=\S)", textwrap.dedent(section).strip()):
                names, _, text = entry.partition(": ")
                explained |= {name.strip(): " ".join(text.split()) for name in names.split(",")}
    return parts[0].strip(), explained


def _names(schema: Any, prefix: str = "") -> dict[str, list[str]]:
    """Return the names of the settings of a dataclass and of nested dataclasses, by the full name of the node."""
    hints = hints_of(schema)
    names = {prefix: list(hints)}
    for name, hint in hints.items():
        if dataclasses.is_dataclass(hint):
            names |= _names(hint, f"{prefix}.{name}".lstrip("."))
    return names


def recall(command: str) -> Described | None:
    """Return the description of a command from the cache; None if a file of nerfro or of a plugin has changed."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads(_cache_file(command).read_text(encoding="utf-8"))
        if content.pop("state") == _state_of_files():
            return Described(**content)
    return None


def remember(command: str, described: Described) -> None:
    """Write the description of a command to the cache, if possible."""
    file = _cache_file(command)
    partial = file.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            content = {"state": _state_of_files(), **dataclasses.asdict(described)}
            partial.write_text(json.dumps(content), encoding="utf-8")
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)


def _cache_file(command: str) -> Path:
    return cache_dir() / f"options_{command}.json"


def _state_of_files() -> str:
    """Hash the names, times and sizes of all files that define options."""
    files = [*PACKAGE_DIR.rglob("*.py"), *CONF_DIR.rglob("*.yaml")]
    for folder in plugin_folders():
        files += [*folder.glob("*.py"), *folder.glob("*/conf/**/*.yaml")]
        files += [file for package in folder.glob("*/__init__.py") for file in package.parent.rglob("*.py")]
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        spec = importlib.util.find_spec(entry_point.module.partition(".")[0])
        places = [] if spec is None else [Path(spec.origin or ""), *map(Path, spec.submodule_search_locations or ())]
        files += [file for place in places for file in ([place] if place.is_file() else place.rglob("*.py"))]
    facts = sorted((str(file), status.st_mtime_ns, status.st_size) for file in files for status in [file.stat()])
    return hashlib.sha256(repr((facts, sys.version)).encode()).hexdigest()
