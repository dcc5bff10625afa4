"""nerfro: novel-view synthesis of refractive objects.

In docstrings and comments, "the paper" is Pan et al., "Sampling Neural Radiance Fields for Refractive Objects"
(SIGGRAPH Asia 2022), and "the authors' code" is their implementation.
"""

from __future__ import annotations

import warnings
from typing import Any

import lazy_loader

# The stub __init__.pyi lists the public names and their modules, which are imported on first access.
_public, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]
# Components that became plugins.
_PLUGINS = {
    "ColmapData": ("data", "colmap"),
    "Distortion": ("loss", "distortion"),
    "Eikonal": ("sampler/path", "eikonal"),
    "Hierarchical": ("sampler/points", "hierarchical"),
    "NerfField": ("field", "nerf"),
    "NerfstudioData": ("data", "nerfstudio"),
    "Skybox": ("boundary", "skybox"),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name == "Scene":
        from nerfro.core.errors import warn_of_old_name

        warn_of_old_name("nerfro.Scene", "nerfro.TrainedScene")
        name = "TrainedScene"
    return _plugin(name) if name in _PLUGINS else _public(name)


def _plugin(name: str) -> type:
    from nerfro.registry.registration import discover, find

    discover()
    kind, plugin = _PLUGINS[name]
    replacement = f"nerfro.registry.registration.find({kind!r}, {plugin!r}).cls"
    warnings.warn(f"nerfro.{name} is a plugin; take {replacement}; the next release removes the name", stacklevel=3)
    return find(kind, plugin).cls


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # importing nerfro should be fast

    try:
        return version(__name__)
    except PackageNotFoundError:  # a checkout that is not installed
        return "0+unknown"
