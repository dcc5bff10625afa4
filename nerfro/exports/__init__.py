"""Exports of a trained scene for other programs: `python -m nerfro.export what=mesh`, `mitsuba`, `sky` or `volume`.

See docs/guides/export_and_share.md.
"""

from nerfro.viewing import PLUGIN_EXPORTS

for _name, _module in (("mesh", "gltf"), ("mitsuba", "mitsuba"), ("sky", "sky"), ("volume", "volume")):
    PLUGIN_EXPORTS[_name] = f"{__name__}.{_module}"
