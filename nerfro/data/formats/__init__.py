"""Data formats of other projects: `data=colmap`, `data=nerfstudio`, `data=llff`, `data=idr` and `data=refref`.

See docs/guides/data_formats.md.
"""

from nerfro.data.formats import colmap, idr, llff, nerfstudio, refref

__all__ = ["colmap", "idr", "llff", "nerfstudio", "refref"]
