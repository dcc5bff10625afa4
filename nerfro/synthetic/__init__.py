"""Rendering of synthetic scenes with Mitsuba 3: `python -m nerfro.synthesize`; `scenes/` holds the scenes.

See docs/guides/synthetic_scenes.md.
"""

from nerfro.synthetic.options import SCENES

for name in ("torus", "ship", "deerglobe", "starlamp", "dolphin_capture"):
    SCENES[name] = f"{__name__}.scenes.{name}"
