"""Synthetic scenes for benchmarks: `python -m nerfro.synthesize scene=ship`; see docs/guides/synthetic_scenes.md."""

from nerfro.synthetic import SCENES

for name in ("torus", "ship", "deerglobe", "starlamp", "dolphin_capture"):
    SCENES[name] = f"{__name__}.{name}"
