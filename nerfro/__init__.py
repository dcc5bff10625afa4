"""nerfro: novel-view synthesis of refractive objects.

In docstrings and comments, "the paper" is Pan et al., "Sampling Neural Radiance Fields for Refractive Objects"
(SIGGRAPH Asia 2022), and "the authors' code" is their implementation.
"""

from __future__ import annotations

from typing import Any

import lazy_loader

# The stub __init__.pyi lists the public names and their modules, which are imported on first access.
_public, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]


def __getattr__(name: str) -> Any:
    return _version() if name == "__version__" else _public(name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # importing nerfro should be fast

    try:
        return version(__name__)
    except PackageNotFoundError:  # a checkout that is not installed
        return "0+unknown"
