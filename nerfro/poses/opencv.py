"""Access to OpenCV, which only the capture commands need."""

from __future__ import annotations

from types import ModuleType

from nerfro.core.errors import optional


def opencv() -> ModuleType:
    """Import OpenCV, or raise an error with the command that installs OpenCV."""
    return optional("cv2", "capture", "OpenCV is needed", ", or opencv-python-headless")
