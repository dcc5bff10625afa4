"""Write the reference pages of the site from the registry and the configuration; a hook of MkDocs.

`python docs/reference_pages.py FOLDER` writes the same pages as Markdown files.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from nerfro.__main__ import commands
from nerfro.allowed import Range
from nerfro.paths import CONF_DIR
from nerfro.registry import KINDS, Plugin, discover, plugins
from nerfro.subdivision import Subdivision, SubdivisionChanges
from nerfro.training import lightning_callbacks  # noqa: F401 - registers callbacks
from nerfro.training.config import REFUSED_ARGUMENTS, TrainConfig, TrainerConfig

_TOOLS = re.compile(r"#\s*(noqa|type:).*?(?= - (?!OmegaConf)|#|$)")  # comments for linters
_CHOOSE = {"loss": "+loss.NAME.weight=0.1", "callbacks": "+callbacks=NAME"}


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to the files of the site."""
    from mkdocs.structure.files import File

    for name, content in pages().items():
        files.append(File.generated(config, f"reference/{name}", content=content))
    return files


def pages() -> dict[str, str]:
    """Return the text of each generated page by its file name."""
    discover()
    return {"commands.md": commands_page(), "configuration.md": configuration_page(), "plugins.md": plugins_page()}


def commands_page() -> str:
    text = [
        "# Commands\n",
        "`nerfro COMMAND key=value ...` and `python -m nerfro.COMMAND key=value ...` are equivalent. This page is "
        "generated from the configuration of each command.\n",
    ]
    for name, purpose in commands().items():
        text.append(f"## {name}\n\n{_sentence(purpose)}\n")
        if name == "train":
            text.append("All settings are listed in [configuration](configuration.md).\n")
        elif (found := command_schema(name)) is not None:
            schema, folder = found
            yaml = (folder / f"{name}.yaml").read_text(encoding="utf-8")
            comments = dict(re.findall(r"^(\w+):.*?\s# (.*)$", yaml, re.MULTILINE))
            text.append(_table(_settings(schema, composed(name, schema, folder), comments)))
    return "\n".join(text)


def configuration_page() -> str:
    text = [
        "# Configuration of a training\n",
        "Settings of `python -m nerfro.train` with the defaults of `conf/train.yaml`. Options of components, such as "
        "`field.*`, are in [plugins](plugins.md). This page is generated from the configuration.\n",
        "## General\n",
    ]
    rows = list(_settings(TrainConfig, composed("train", TrainConfig, CONF_DIR), {}))
    text.append(_table(row for row in rows if "." not in row[0]))
    sections = dict.fromkeys(row[0].split(".")[0] for row in rows if "." in row[0])
    for section in sections:
        text.append(f"## {section}\n")
        text.append(_table(row for row in rows if row[0].startswith(f"{section}.")))
    for folder, title in (("experiment", "Experiments"), ("scene", "Scenes"), ("sweep", "Sweeps")):
        files = sorted((CONF_DIR / folder).glob("*.yaml"))
        text.append(f"## {title}\n\n| `+{folder}=` | contents |\n|---|---|")
        text.extend(f"| `{file.stem}` | {_cell(_header(file))} |" for file in files)
        text.append("")
    return "\n".join(text)


def plugins_page() -> str:
    text = [
        "# Components and their options\n",
        "Every component is a [plugin](../guides/plugins.md). This page is generated from the registry; "
        "`python -m nerfro.plugins` prints the same list, including your own plugins.\n",
    ]
    for kind in KINDS:
        choose = f"Choose with `{_CHOOSE.get(kind, f'{kind}=NAME')}`."
        text.append(f"## {kind}\n\n{'Every metric is scored.' if kind == 'metric' else choose}\n")
        for plugin in plugins(kind):
            if ".example_" not in plugin.target:  # templates
                text.append(_plugin(plugin))
    return "\n".join(text)


def _plugin(plugin: Plugin) -> str:
    if plugin.target.startswith("lightning."):  # Lightning documents its callbacks in another markup
        fields = ", ".join(f"`{name}`" for name, *_ in plugin.fields())
        return f"### {plugin.name}\n\n`{plugin.target}`" + (f" with the options {fields}.\n" if fields else ".\n")
    body, _ = _google_docstring(inspect.getdoc(plugin.cls) or "")
    explained: dict[str, str] = {}
    for base in plugin.cls.__mro__:
        for documented in (vars(base).get("__init__"), base):
            explained = _google_docstring(inspect.cleandoc(documented.__doc__ or ""))[1] | explained
    prefix = plugin.kind.replace("/", ".") + ("." if plugin.kind not in _CHOOSE else f".{plugin.name}.")
    rows = [
        (prefix + name, _type(plugin.hints[name]), default, explained.get(name, ""))
        for name, _, default in plugin.fields()
    ]
    return f"### {plugin.name}\n\n{body}\n\n{_table(rows)}"


def _google_docstring(docstring: str) -> tuple[str, dict[str, str]]:
    """Split a docstring into its text and the explanations of the sections Args and Attributes."""
    parts = re.split(r"^(Args|Attributes|Returns|Raises|Shape|Example[s]?|Note):\n", docstring, flags=re.MULTILINE)
    explained: dict[str, str] = {}
    for title, section in zip(parts[1::2], parts[2::2], strict=True):
        if title in ("Args", "Attributes"):
            for entry in re.split(r"\n(?=\S)", textwrap.dedent(section).strip()):
                names, _, text = entry.partition(": ")
                explained |= {name.strip(): " ".join(text.split()) for name in names.split(",")}
    return parts[0].strip(), explained


def command_schema(command: str) -> tuple[type, Path] | None:
    """Return the dataclass of the options of a command, and the folder of its YAML file; None without options."""
    module = importlib.import_module(f"nerfro.{command}")
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "entry_point":
            folder = CONF_DIR / command
            return getattr(module, ast.unparse(node.args[1])), folder if folder.is_dir() else CONF_DIR
    return None


def composed(command: str, schema: type, folder: Path) -> DictConfig:
    """Compose the default configuration of a command."""
    ConfigStore.instance().store(name=f"{command}_schema", node=schema, provider="nerfro")
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose(command)


def _settings(
    schema: type, values: Any, comments: dict[str, str], prefix: str = ""
) -> Iterator[tuple[str, str, object, str]]:
    """Yield name, type, default and explanation of each setting of a dataclass and of nested dataclasses."""
    hints = get_type_hints(schema, include_extras=True)
    documented = Subdivision if schema is SubdivisionChanges else schema
    explained = _google_docstring(inspect.getdoc(documented) or "")[1] | _field_comments(schema)
    for field in dataclasses.fields(schema):
        hint, name = hints[field.name], prefix + field.name
        refused = REFUSED_ARGUMENTS if schema is TrainerConfig else {}
        if field.name.startswith("_") or field.name in refused:
            continue
        if dataclasses.is_dataclass(hint):
            yield from _settings(hint, values[field.name], {}, f"{name}.")
            continue
        default = OmegaConf.to_container(values, resolve=False).get(field.name, field.default)
        text = comments.get(field.name) or explained.get(field.name, "")
        if schema is TrainerConfig and not text:
            text = "as in `lightning.Trainer`"
        if hint is Any and isinstance(default, dict):
            kind = name.replace(".", "/")
            text = f"component, see [{kind}](plugins.md#{kind.replace('/', '')})" if kind in KINDS else text
            default = _choice(default)
        if isinstance(default, dict) and default:
            default = ", ".join(default) if field.name == "loss" else default
        yield name, _type(hint), "required" if default == MISSING else default, text


def _choice(default: object) -> object:
    """Return the registered name of a component for its configuration."""
    target = default.get("_target_") if isinstance(default, dict) else None
    return next((plugin.name for plugin in plugins() if plugin.target == target), "see `conf/`" if default else default)


def _field_comments(schema: type) -> dict[str, str]:
    """Return the comments of the fields of a dataclass: on the line of the field, or on the lines above."""
    lines = inspect.getsource(schema).split("\n")
    found = {}
    for node in ast.parse(textwrap.dedent("\n".join(lines))).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign):
            continue
        above, number = [], node.lineno - 2
        while lines[number].lstrip().startswith("#"):
            above.insert(0, lines[number].lstrip(" #"))
            number -= 1
        end = lines[(node.end_lineno or node.lineno) - 1].partition("  #")[2]
        beside = _TOOLS.sub("", f"#{end}").lstrip("# -") if end else ""
        inside = [part for line in lines[node.lineno : node.end_lineno] if (part := line.partition("  # ")[2])]
        found[ast.unparse(node.target)] = " ".join([*above, *inside, beside]).strip()
    return {name: comment for name, comment in found.items() if comment}


def _type(hint: Any) -> str:
    """Describe a type and its allowed values."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in args)
    if origin is Annotated:
        limits = [str(limit) for limit in args[1:] if isinstance(limit, Range)]
        choices = [limit for limit in args[1:] if get_origin(limit) is Literal]
        return _type(choices[0]) if choices else ", ".join([_type(args[0]), *limits])
    if type(None) in args:
        return "; ".join(_type(arg) for arg in args if arg is not type(None)) + "; or null"
    if origin in (list, tuple) or getattr(origin, "__name__", "") == "Sequence":
        return f"list of {_type(args[0])}"
    if origin is dict:
        return "mapping"
    return "any" if hint is Any else getattr(hint, "__name__", str(hint))


def _table(rows: Any) -> str:
    lines = [
        f"| `{name}` | {_cell(kind)} | {_default(default)} | {_cell(_sentence(text))} |"
        for name, kind, default, text in rows
    ]
    return "\n".join(["| option | type | default | meaning |", "|---|---|---|---|", *lines, ""]) if lines else ""


def _default(value: object) -> str:
    if value is None:
        return "null"
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if value in ("required", "see `conf/`") else f"`{_cell(text)}`" if text else "empty"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def _header(file: Path) -> str:
    """Return the comment at the start of a YAML file."""
    lines = file.read_text(encoding="utf-8").split("\n")
    comment = []
    for line in lines[1:]:
        if not line.startswith("#"):
            break
        comment.append(line.lstrip("# "))
    return " ".join(comment)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""


if __name__ == "__main__":
    for page, content in pages().items():
        Path(sys.argv[1], page).write_text(content, encoding="utf-8")
