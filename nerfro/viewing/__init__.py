"""Trained scenes: rendering, films, interactive pages and export to other programs."""
