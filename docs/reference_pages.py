"""Write the reference pages of the site from the registry and the configuration; a hook of MkDocs.

`python docs/reference_pages.py FOLDER` writes the same pages as Markdown files.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from nerfro.__main__ import commands
from nerfro.cli.options import google_docstring, plugin_options, schema_options, store_schema
from nerfro.core.paths import CONF_DIR
from nerfro.registry.registration import KINDS, Plugin, discover, plugins
from nerfro.training.config import TrainConfig

_CHOOSE = {"loss": "+loss.NAME.weight=0.1", "phase": "+phase.NAME={}", "callbacks": "callbacks=NAME"}
_BODY = "bodies={BODY: {surface: {name: NAME}, ior: 1.5}}"


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to the files of the site."""
    from mkdocs.structure.files import File

    for name, content in pages().items():
        files.append(File.generated(config, f"reference/{name}", content=content))
    return files


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Name the search dialog of the theme, which has no accessible name."""
    return output.replace(
        'data-md-component="search" role="dialog"', 'data-md-component="search" role="dialog" aria-label="Search"'
    )


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
        text.append(f"## {name}\n\n{purpose[:1].upper()}{purpose[1:]}\n")
        if name == "train":
            text.append("All settings are listed in [configuration](configuration.md).\n")
        elif (schema := command_schema(name)) is not None:
            text.append(_table(schema_options(schema, compose_defaults(name, schema))))
    return "\n".join(text)


def configuration_page() -> str:
    text = [
        "# Configuration of a training\n",
        "Settings of `python -m nerfro.train` with the defaults of `conf/train.yaml`. Components, such as "
        "`field`, and their options are in [plugins](plugins.md). This page is generated from the configuration.\n",
        "## General\n",
    ]
    rows = list(schema_options(TrainConfig, compose_defaults("train", TrainConfig)))
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
        choose = f"Choose with `{_BODY if kind == 'surface' else _CHOOSE.get(kind, f'{kind}=NAME')}`."
        text.append(f"## {kind}\n\n{'Every metric is scored.' if kind == 'metric' else choose}\n")
        for plugin in plugins(kind):
            if ".example_" not in plugin.target:  # templates
                text.append(_plugin(plugin))
    return "\n".join(text)


def _plugin(plugin: Plugin) -> str:
    if plugin.target.startswith("lightning."):  # Lightning documents its callbacks in another markup
        fields = ", ".join(f"`{name}`" for name, *_ in plugin.fields())
        return f"### {plugin.name}\n\n`{plugin.target}`" + (f" with the options {fields}.\n" if fields else ".\n")
    body, _ = google_docstring(inspect.getdoc(plugin.cls) or "")
    prefix = plugin.kind.replace("/", ".") + ("." if plugin.kind not in _CHOOSE else f".{plugin.name}.")
    rows = plugin_options(plugin, "" if plugin.kind == "surface" else prefix)
    return f"### {plugin.name}\n\n{body}\n\n{_table(rows)}"


def command_schema(command: str) -> type | None:
    """Return the dataclass of the options of a command; None without options."""
    module = importlib.import_module(f"nerfro.{command}")
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("entry_point", "command"):
            return getattr(module, ast.unparse(node.args[1]))
    return None


def compose_defaults(command: str, schema: type) -> dict[str, Any]:
    """Compose the default configuration of a command; empty for a command without groups."""
    if not (CONF_DIR / f"{command}.yaml").is_file():
        return {}
    store_schema(command, schema)
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return cast(dict, OmegaConf.to_container(compose(command)))


def _table(rows: Any) -> str:
    lines = [
        f"| `{name}` | {_cell(kind)} | {_default(default)} | {_cell(text)} |" for name, kind, default, text in rows
    ]
    return "\n".join(["| option | type | default | meaning |", "|---|---|---|---|", *lines, ""]) if lines else ""


def _default(value: object) -> str:
    if value is None:
        return "null"
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if value == "required" else _cell(f"`{text}`") if text else "empty"


def _cell(text: str) -> str:
    text = text.replace("|", "\\|").replace("\n", " ")
    # Markdown itself escapes the text of code spans.
    return "".join(part if part.startswith("`") else part.replace("<", "&lt;") for part in re.split("(`[^`]*`)", text))


def _header(file: Path) -> str:
    """Return the comment at the start of a YAML file."""
    lines = file.read_text(encoding="utf-8").split("\n")
    comment = []
    for line in lines[1:]:
        if not line.startswith("#"):
            break
        comment.append(line.lstrip("# "))
    return " ".join(comment)


if __name__ == "__main__":
    for page, content in pages().items():
        Path(sys.argv[1], page).write_text(content, encoding="utf-8")
