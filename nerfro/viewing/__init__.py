"""Trained scenes: rendering, films, interactive pages and export to other programs."""

PLUGIN_EXPORTS: dict[str, str] = {"page": "nerfro.viewing.page"}
"""Module of each export, by the name in `what=`; plugins add exports. `EXPORT` in the module is an `exports.Export`."""
