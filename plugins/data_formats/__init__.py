"""Data formats of other papers: `data=llff`, `data=idr` and `data=refref`; see docs/guides/data_formats.md."""

from . import idr, llff, refref

__all__ = ["idr", "llff", "refref"]
