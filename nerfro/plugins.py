"""`python -m nerfro.plugins`: list the registered plugins with their settings, defaults and summaries."""

from __future__ import annotations

import sys

import rich
from rich.console import Group
from rich.table import Table
from rich.text import Text

import nerfro.training.lightning_callbacks  # noqa: F401 - registers callbacks
from nerfro.cli import errors_in_one_line
from nerfro.registry import Plugin, discover, find, plugins


def main() -> None:
    """List all plugins, or those of the types (`medium`) or options (`medium=ball`) on the command line."""
    with errors_in_one_line():
        discover()
        for plugin in _chosen(sys.argv[1:]):
            rich.print(describe(plugin))


def describe(plugin: Plugin) -> Group:
    """Format the name, summary and settings of a plugin for the console."""
    table = Table("field", "type", "default", box=None, pad_edge=False, show_header=False)
    for name, kind, default in plugin.fields():
        table.add_row(f"    {name}", Text(kind), str(default))  # Text, because brackets would be markup
    heading = Text.assemble((f"{plugin.kind}={plugin.name}", "bold"), f"  {plugin.summary}")
    return Group(heading, table) if table.rows else Group(heading)


def _chosen(arguments: list[str]) -> list[Plugin]:
    if not arguments:
        return plugins()
    chosen = []
    for argument in arguments:
        kind, _, name = argument.partition("=")
        of_kind = plugins(kind)
        chosen += [find(kind, name)] if name else of_kind
    return chosen


if __name__ == "__main__":
    main()
