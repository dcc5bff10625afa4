"""Exports of a trained scene for other programs, such as `what=mesh`, `splats`, `colmap` or `mitsuba`.

See docs/guides/export_and_share.md.
"""
