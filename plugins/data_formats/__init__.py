"""Data formats of other projects: `data=nerfstudio`, `data=llff`, `data=idr` and `data=refref`.

See docs/guides/data_formats.md.
"""

from . import idr, llff, nerfstudio, refref

__all__ = ["idr", "llff", "nerfstudio", "refref"]
