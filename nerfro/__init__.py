"""nerfro: novel-view synthesis of refractive objects."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfro.samplers.bend import bend
    from nerfro.training.load import load
    from nerfro.viewing.scene import Scene

__version__ = "0.1.0"
__all__ = ["Scene", "__version__", "bend", "load"]

_HOMES = {"Scene": "nerfro.viewing.scene", "bend": "nerfro.samplers.bend", "load": "nerfro.training.load"}


def __getattr__(name: str) -> Any:
    """What is imported when it is asked for: `import nerfro` itself costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'nerfro' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)
