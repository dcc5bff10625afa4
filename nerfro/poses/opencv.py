"""Access to OpenCV, which only the capture commands need."""

from __future__ import annotations

import functools
from types import ModuleType

from nerfro.core.errors import NerfroError


@functools.cache
def opencv() -> ModuleType:
    """Import OpenCV, or raise an error with the command that installs OpenCV."""
    try:
        import cv2
    except ImportError as error:
        message = f"OpenCV is needed ({error}); pip install 'nerfro[capture]', or opencv-python-headless"
        raise NerfroError(message) from error
    return cv2
