"""`python -m nerfro.plugins`: every registered part with its fields, defaults and first line of documentation."""

from __future__ import annotations

import sys

import rich
from rich.console import Group
from rich.table import Table
from rich.text import Text

from nerfro.errors import NerfroError
from nerfro.registry import KINDS, Plugin, discover, plugins


def main() -> None:
    """List the plugins of the kinds (or `kind=name`) given on the command line, or all."""
    try:
        discover()
        for plugin in _chosen(sys.argv[1:]):
            rich.print(describe(plugin))
    except NerfroError as error:
        print(f"nerfro: error: {error}", file=sys.stderr)
        sys.exit(1)


def describe(plugin: Plugin) -> Group:
    """A plugin's name, summary and fields, for the console."""
    table = Table("field", "type", "default", box=None, pad_edge=False, show_header=False)
    for name, kind, default in plugin.fields():
        table.add_row(f"    {name}", kind, str(default))
    heading = Text.assemble((f"{plugin.kind}={plugin.name}", "bold"), f"  {plugin.summary}")
    return Group(heading, table) if table.rows else Group(heading)


def _chosen(arguments: list[str]) -> list[Plugin]:
    chosen = []
    for argument in arguments:
        kind, _, name = argument.partition("=")
        if kind not in KINDS:
            raise NerfroError(f"'{kind}' is not a plugin kind; kinds: {', '.join(KINDS)}")
        found = [p for p in plugins(kind) if name in ("", p.name)]
        if not found:
            raise NerfroError(f"no {kind} is called '{name}'; known: {', '.join(p.name for p in plugins(kind))}")
        chosen += found
    return chosen if arguments else plugins()


if __name__ == "__main__":
    main()
