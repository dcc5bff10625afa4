"""Refinement of inaccurate camera poses in training (docs/guides/imperfect_poses.md): `camera=refined`.

The phase `cameras` aligns the cameras by the panorama of the sky and by the outlines of the masks, and moves them by
Gauss-Newton steps between training steps.
"""
