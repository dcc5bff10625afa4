"""`python -m nerfro.plugins`: list the registered plugins with their settings, defaults and summaries.

Examples:
    nerfro plugins
    nerfro plugins medium field=hash_grid
"""

from __future__ import annotations

import sys

import nerfro.startup
import nerfro.training.lightning_callbacks  # noqa: F401 - registers callbacks
from nerfro.cli import errors_in_one_line
from nerfro.options import plugin_options
from nerfro.registry import Plugin, discover, find, plugins


def main() -> None:
    """List all plugins, or those of the types (`medium`) or options (`medium=ball`) on the command line."""
    with errors_in_one_line():
        discover()
        for plugin in _chosen(sys.argv[1:]):
            print(f"{plugin.kind}={plugin.name}  {plugin.summary}")
            for option in plugin_options(plugin, ""):
                print(option)


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
