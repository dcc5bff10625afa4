"""Exports of a trained scene for other programs: `python -m nerfro.export what=mesh`, `mitsuba`, `sky` or `volume`.

See docs/guides/export_and_share.md.
"""
