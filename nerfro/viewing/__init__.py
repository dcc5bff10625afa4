"""Trained scenes: rendering, films, interactive pages and export to other programs."""

PLUGIN_EXPORTS: dict[str, str] = {}
"""Module of each export that a plugin adds, by the name in `what=`; `EXPORT` in the module is an `exports.Export`."""
