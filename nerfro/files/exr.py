"""OpenEXR pictures."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfro.files.atomic import write_atomically


def save_exr(path: Path, values: Float[np.ndarray, "H W C"]) -> None:
    """Write a picture of one or three channels in single precision, compressed without loss."""
    import OpenEXR

    channels = {"RGB": values} if values.shape[-1] == 3 else {"Y": values[..., 0]}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder, "picture.exr")
        planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
        OpenEXR.File(header, planes).write(str(made))
        write_atomically(path, made.read_bytes())


def load_exr(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Red, green and blue of a file.

    Raises:
        OSError: it cannot be read, or has other channels.
    """
    import OpenEXR

    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        return np.stack([channels[name].pixels.astype(np.float32) for name in "RGB"], -1)
    except (RuntimeError, KeyError) as error:
        raise OSError(f"no OpenEXR picture of red, green and blue: {error}") from error
