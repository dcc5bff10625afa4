"""Photographs in the raw formats of cameras, developed to linear light by rawpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.optional import optional

RAW_SUFFIXES = (
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2",
    ".srw", ".x3f",
)  # fmt: skip


def read_raw(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Develop a raw photograph to linear radiance with the white balance that the camera has stored.

    The image has sRGB primaries, and is turned as the camera was held. The level at which the sensor saturates is 1 in
    all channels and equal in all photographs, because the brightness is not adapted to the content.

    Raises:
        NerfroError: rawpy is missing.
    """
    with _open(path) as raw:
        options = {"no_auto_bright": True, "adjust_maximum_thr": 0.0, "gamma": (1, 1), "output_bps": 16}
        levels = raw.postprocess(use_camera_wb=True, **options)
    # The conversion of colours rounds saturated levels to slightly less than the maximum, 65535.
    return np.where(levels >= 65500, np.float32(1), levels / np.float32(65535))


def raw_size(path: Path) -> tuple[int, int]:
    """Read width and height of the image of `read_raw` from the header of a raw photograph."""
    with _open(path) as raw:
        sizes = raw.sizes
    turned = sizes.flip in (5, 6)  # by a quarter
    return (sizes.iheight, sizes.iwidth) if turned else (sizes.iwidth, sizes.iheight)


def _open(path: Path) -> Any:
    rawpy = optional("rawpy", "capture", f"{path} needs rawpy", ", or convert the photographs to .exr or 16-bit PNG")
    return rawpy.imread(str(path))
