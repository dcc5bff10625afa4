"""Lens and camera poses of photographs: `python -m nerfro.calibrate`, by boards of AprilTags or by COLMAP.

`collection.py` prepares photographs and videos for `python -m nerfro.reconstruct`. See docs/guides/camera_poses.md.
"""
