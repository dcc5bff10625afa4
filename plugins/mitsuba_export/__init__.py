"""Export of trained scenes for Mitsuba 3: `python -m nerfro.export what=mitsuba`.

See docs/guides/export_and_share.md.
"""

from nerfro.viewing import PLUGIN_EXPORTS

PLUGIN_EXPORTS["mitsuba"] = f"{__name__}.scene"
