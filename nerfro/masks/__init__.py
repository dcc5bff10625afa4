"""Masks of the object in photographs: `python -m nerfro.mask`.

Masks follow from polygons, from GrabCut guided by the visual hull, or from Segment Anything 2; see
docs/guides/masks.md.
"""
