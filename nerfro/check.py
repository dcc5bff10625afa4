"""`python -m nerfro.check TYPE=NAME [SETTING=VALUE]`: check plugins against their contracts, and their optics.

Examples:
    nerfro check field=hash_grid
    nerfro check sampler/path=eikonal sampler.path.tolerance=0.001
    nerfro check export=volume
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.calls import values_of
from nerfro.cli.failures import errors_in_one_line
from nerfro.core.errors import NerfroError
from nerfro.registry.registration import KINDS, Plugin, build, discover, find
from nerfro.testing import ContractError, check, check_export, check_optics


def main() -> None:
    """Check the plugins on the command line, and exit with status 1 if one breaks its contract.

    Path samplers that need a medium are also compared with closed forms of optics (`nerfro.testing.check_optics`).
    """
    with errors_in_one_line():
        discover()
        exports = [text.partition("=")[2] for text in sys.argv[1:] if text.startswith("export=")]
        others = [text for text in sys.argv[1:] if not text.startswith("export=")]
        pairs = _selected(others) if others or not exports else []
        try:
            for plugin, settings in pairs:
                _check(plugin, settings)
            for name in exports:
                print(f"export={name}", flush=True)
                check_export(name)
                print("  keeps the contract of exports", flush=True)
        except ContractError as error:
            raise NerfroError(str(error)) from error


def _check(plugin: Plugin, settings: Mapping[str, Any]) -> None:
    print(f"{plugin.kind}={plugin.name}  {plugin.summary}", flush=True)
    check(plugin, settings)
    print("  keeps the contract of its type", flush=True)
    if plugin.kind == "sampler/path":
        sampler = build({"_target_": plugin.target, **settings})
        if sampler.needs_medium:
            check_optics(sampler)


def _selected(arguments: Sequence[str]) -> list[tuple[Plugin, Mapping[str, Any]]]:
    """Return the plugins that arguments such as `field=nerf` name, with the settings of the other arguments."""
    pairs = [(kind, name) for kind, _, name in (text.partition("=") for text in arguments) if kind in KINDS]
    selected = [find(kind, name) for kind, name in pairs]
    if not selected:
        raise NerfroError(
            f"name a plugin to check as TYPE=NAME, such as sampler/path=mine; types: {', '.join(KINDS)}, export"
        )
    others = [text for text in arguments if text.partition("=")[0] not in KINDS]
    for text in others:
        if not text.startswith(tuple(plugin.prefix for plugin in selected)):
            raise NerfroError(f"{text} is no setting of a plugin to check; settings begin with {selected[0].prefix}")
    values = values_of(others)
    settings = []
    for plugin in selected:
        node: Any = values
        for part in plugin.prefix.split(".")[:-1]:
            node = node.get(part, {})
        settings.append(node)
    return list(zip(selected, settings, strict=True))


if __name__ == "__main__":
    main()
