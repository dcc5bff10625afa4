"""nerfro: novel-view synthesis of refractive objects."""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfro.samplers.bend import bend
    from nerfro.training.load import load
    from nerfro.viewing.trained_scene import TrainedScene

__version__ = "0.1.0"
__all__ = ["TrainedScene", "__version__", "bend", "load"]

_HOMES = {
    "TrainedScene": "nerfro.viewing.trained_scene",
    "bend": "nerfro.samplers.bend",
    "load": "nerfro.training.load",
}


def __getattr__(name: str) -> Any:
    """Import the public names on first access, so that `import nerfro` is fast."""
    if name == "Scene":
        warnings.warn("nerfro.Scene is called nerfro.TrainedScene; the next release removes the old name", stacklevel=2)
        name = "TrainedScene"
    if name not in _HOMES:
        raise AttributeError(f"module 'nerfro' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)
