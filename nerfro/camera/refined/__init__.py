"""Refinement of inaccurate camera poses in training (docs/guides/imperfect_poses.md): `camera=refined`.

The plugin consists of the camera model and of the phase `cameras`, which aligns the cameras by the panorama of the sky
and by the outlines of the masks, and moves them by Gauss-Newton steps between training steps.
"""

from nerfro.camera.refined import phase, refined

__all__ = ["phase", "refined"]
