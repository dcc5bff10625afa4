"""Data formats of other projects: `data=colmap`, `data=nerfstudio`, `data=llff`, `data=idr` and `data=refref`.

See docs/guides/data_formats.md.
"""
