"""Exports of a trained scene for other programs: `what=mesh`, `mitsuba`, `sky`, `volume`, `colmap` or `cameras`.

See docs/guides/export_and_share.md.
"""
