"""Masks of the object in photographs: outlines, GrabCut, visual hull, and Segment Anything 2."""
