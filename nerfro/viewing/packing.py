"""Arrays as PNG pictures in text: a browser's own decoder unpacks them, and smooth arrays become small."""

from __future__ import annotations

import base64
import io
import math

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

# Of RGB9_E5, OpenGL's format of three mantissas with a common exponent (OpenGL ES 3.0, section 3.8.3.2).
_MANTISSA_BITS, _EXPONENT_BIAS, _MAX_EXPONENT = 9, 15, 31
_LARGEST = (1 - 0.5**_MANTISSA_BITS) * 2.0 ** (_MAX_EXPONENT - _EXPONENT_BIAS)


def pack(voxels: UInt8[np.ndarray, "Z Y X C"], compression: int = 9) -> str:
    """One, two or three bytes for each voxel, as `data:` address of a picture whose tiles are the slices.

    Always RGB: some browsers correct the colours of grey pictures, and multiply those that have transparency.
    """
    depth, height, width, channels = voxels.shape
    columns = math.ceil(math.sqrt(depth))
    rows = math.ceil(depth / columns)
    tiles = np.zeros((rows * columns, height, width, 3), np.uint8)
    tiles[:depth, ..., :channels] = voxels
    mosaic = tiles.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    return data_uri(mosaic, compression)


def data_uri(picture: UInt8[np.ndarray, "H W 3"], compression: int = 9) -> str:
    """A picture as `data:` address of a PNG."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=compression)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def two_bytes(steps: Int[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 2"]:
    """Whole numbers from -32768 to 32767, raised by 32768: upper and lower byte."""
    raised = (steps + 2**15).astype(np.uint16)
    return np.stack([raised >> 8, raised & 255], -1).astype(np.uint8)


def shared_exponent(
    radiance: Float[np.ndarray, "*shape 3"],
) -> tuple[UInt8[np.ndarray, "*shape 3"], UInt8[np.ndarray, "*shape 1"]]:
    """Radiance as RGB9_E5: upper eight bits of the mantissas, and the exponent (x 8) with their lowest bits."""
    clipped = np.clip(radiance, 0, _LARGEST)
    exponent = _exponent(clipped.max(-1))
    # Rounding may need one more bit.
    fits = np.round(clipped.max(-1) / _unit(exponent)) < 2**_MANTISSA_BITS
    exponent = np.where(fits, exponent, exponent + 1)
    mantissa = np.round(clipped / _unit(exponent)[..., None]).astype(np.int64)
    lowest = ((mantissa & 1) * [1, 2, 4]).sum(-1)
    return (mantissa >> 1).astype(np.uint8), (exponent * 8 + lowest).astype(np.uint8)[..., None]


def _exponent(brightest: Float[np.ndarray, "*shape"]) -> Int[np.ndarray, "*shape"]:
    smallest = 2.0 ** -(_EXPONENT_BIAS + 1)
    floor = np.floor(np.log2(np.maximum(brightest, smallest))).astype(np.int64)
    return np.maximum(floor + 1 + _EXPONENT_BIAS, 0)


def _unit(exponent: Int[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """What one step of a mantissa stands for."""
    return 2.0 ** (exponent.astype(np.float64) - _EXPONENT_BIAS - _MANTISSA_BITS)
