"""`python -m nerfro.plugins`: every registered part with its fields, defaults and first line of documentation."""

from __future__ import annotations

import sys

import rich
from rich.console import Group
from rich.table import Table
from rich.text import Text

from nerfro.cli import errors_in_one_line
from nerfro.registry import Plugin, discover, find, plugins


def main() -> None:
    """List the plugins of the kinds (or `kind=name`) given on the command line, or all."""
    with errors_in_one_line():
        discover()
        for plugin in _chosen(sys.argv[1:]):
            rich.print(describe(plugin))


def describe(plugin: Plugin) -> Group:
    """A plugin's name, summary and fields, for the console."""
    table = Table("field", "type", "default", box=None, pad_edge=False, show_header=False)
    for name, kind, default in plugin.fields():
        table.add_row(f"    {name}", Text(kind), str(default))  # its brackets are no markup
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
