"""`python -m nerfro.plugins`: list the registered plugins with their settings, defaults and summaries.

Examples:
    nerfro plugins
    nerfro plugins medium field=hash_grid
    nerfro plugins material
    nerfro plugins settings
"""

from __future__ import annotations

import inspect
import sys

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.failures import errors_in_one_line
from nerfro.cli.options import laid_out, plugin_options
from nerfro.core.provenance import AlgorithmSettings
from nerfro.media.material import MATERIALS
from nerfro.registry.registration import Plugin, discover, find, plugins


def main() -> None:
    """List all plugins, or those of the types (`medium`) or options (`medium=vacuum`) on the command line.

    The type `material` stands for the catalogue of materials, and `settings` for the tuned numbers of algorithms.
    """
    with errors_in_one_line():
        discover()
        arguments, catalogues = sys.argv[1:], {"material": _print_materials, "settings": _print_settings}
        for name in [name for name in catalogues if name in arguments]:
            catalogues[name]()
            arguments.remove(name)
            if not arguments:
                return
        for plugin in _chosen(arguments):
            print(f"{plugin.kind}={plugin.name}  {plugin.summary}")
            for option in plugin_options(plugin, ""):
                print(laid_out(str(option)))


def _print_materials() -> None:
    """Print the materials that `bodies.NAME.material` may name, with index, Abbe number and source."""
    for name, formula in MATERIALS.items():
        print(f"material={name}  {formula.description}")
        print(f"    n_d = {formula.ior:.4f}, Abbe number {formula.abbe:.1f}; {formula.source}")


def _print_settings() -> None:
    """Print the settings of algorithms, which Python code passes as the argument `settings`, with their defaults."""
    # These imports register the settings; the import of Lightning by the trials takes seconds.
    import nerfro.capture.refinement
    import nerfro.capture.vessel_fit
    import nerfro.masks.masking
    import nerfro.pipeline.trials
    import nerfro.poses.structure_from_motion
    import nerfro.silhouettes.surface  # noqa: F401

    for settings in AlgorithmSettings.classes.values():
        print(f"{settings.__module__}.{settings()!r}\n\n{inspect.getdoc(settings)}\n")


def _chosen(arguments: list[str]) -> list[Plugin]:
    if not arguments:
        return plugins()
    selected = []
    for argument in arguments:
        kind, _, name = argument.partition("=")
        of_kind = plugins(kind)
        selected += [find(kind, name)] if name else of_kind
    return selected


if __name__ == "__main__":
    main()
