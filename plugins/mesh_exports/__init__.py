"""Exports of a trained scene with meshes: `python -m nerfro.export what=mesh` (glTF) and `what=mitsuba` (Mitsuba 3).

See docs/guides/export_and_share.md.
"""

from nerfro.viewing import PLUGIN_EXPORTS

PLUGIN_EXPORTS["mesh"] = f"{__name__}.gltf"
PLUGIN_EXPORTS["mitsuba"] = f"{__name__}.mitsuba"
