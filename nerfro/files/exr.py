"""OpenEXR pictures, by Mitsuba."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float

from nerfro.errors import NerfroError


def encode_exr(values: Float[np.ndarray, "H W C"]) -> bytes:
    """The file of a picture of one or three channels, in single precision."""
    mitsuba = _mitsuba()
    stream = mitsuba.MemoryStream()
    mitsuba.Bitmap(np.ascontiguousarray(values, np.float32)).write(stream, mitsuba.Bitmap.FileFormat.OpenEXR)
    return stream.raw_buffer()


def load_exr(path: Path) -> Float[np.ndarray, "H W C"]:
    """The values of a file; those of Mitsuba's reader on damage are passed on."""
    return np.array(_mitsuba().Bitmap(str(path)), np.float32)


def _mitsuba() -> ModuleType:
    try:
        import mitsuba
    except ImportError as error:
        raise NerfroError(
            "OpenEXR files need Mitsuba: pip install 'nerfro[synthesize]', or take .hdr or .png"
        ) from error
    if mitsuba.variant() is None:
        mitsuba.set_variant("scalar_rgb")
    return mitsuba
