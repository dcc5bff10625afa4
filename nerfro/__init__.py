"""nerfro: novel-view synthesis of refractive objects.

In docstrings and comments, "the paper" is Pan et al., "Sampling Neural Radiance Fields for Refractive Objects"
(SIGGRAPH Asia 2022), and "the authors' code" is their implementation.
"""

from __future__ import annotations

import sys
import types
from typing import Any

import lazy_loader

# The stub __init__.pyi lists the public names and their modules, which are imported on first access.
_public, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]


class _Front(types.ModuleType):
    """The package `nerfro`, whose names never become modules.

    `nerfro.train` is a function, and `python -m nerfro.train` a command. Python assigns an imported submodule to the
    name of the function, in the main program of a command or by `import nerfro.train`; this assignment has no effect.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, types.ModuleType) and name in _names):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Front


def __getattr__(name: str) -> Any:
    return _version() if name == "__version__" else _public(name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # importing nerfro should be fast

    try:
        return version(__name__)
    except PackageNotFoundError:  # a checkout that is not installed
        return "0+unknown"
