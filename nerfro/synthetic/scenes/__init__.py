"""The synthetic scenes."""

from __future__ import annotations

from types import ModuleType

from nerfro.synthetic.scenes import deerglobe, dolphin_capture, ship, starlamp, torus

SCENES: dict[str, ModuleType] = {
    "torus": torus,
    "ship": ship,
    "deerglobe": deerglobe,
    "starlamp": starlamp,
    "dolphin_capture": dolphin_capture,
}
"""Module of each scene, by name; plugins add scenes. `build(spacing)` of the module returns the `SyntheticScene`."""
