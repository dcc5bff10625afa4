"""Encoding of arrays as PNG images in text, which browsers decode and which compress smooth arrays well."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int, UInt8

from nerfro.files.images import data_uri

# Format RGB9_E5: three mantissas with a common exponent (OpenGL ES 3.0, section 3.8.3.2).
_MANTISSA_BITS, _EXPONENT_BIAS, _MAX_EXPONENT = 9, 15, 31
_LARGEST = (1 - 0.5**_MANTISSA_BITS) * 2.0 ** (_MAX_EXPONENT - _EXPONENT_BIAS)


def pack(voxels: UInt8[np.ndarray, "Z Y X C"], compression: int = 9) -> str:
    """Encode one, two or three bytes per voxel as the data URI of an image whose tiles are the slices.

    The image is always RGB: some browsers change grey values for display, and multiply colours by alpha.
    """
    depth, height, width, channels = voxels.shape
    columns = math.ceil(math.sqrt(depth))
    rows = math.ceil(depth / columns)
    tiles = np.zeros((rows * columns, height, width, 3), np.uint8)
    tiles[:depth, ..., :channels] = voxels
    mosaic = tiles.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    return data_uri(mosaic, "PNG", compress_level=compression)


def two_bytes(steps: Int[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 2"]:
    """Encode integers from -32768 to 32767, plus 32768, as upper and lower byte."""
    raised = (steps + 2**15).astype(np.uint16)
    return np.stack([raised >> 8, raised & 255], -1).astype(np.uint8)


def shared_exponent(
    radiance: Float[np.ndarray, "*shape 3"],
) -> tuple[UInt8[np.ndarray, "*shape 3"], UInt8[np.ndarray, "*shape 1"]]:
    """Encode radiance as RGB9_E5: upper eight bits of the mantissas, and exponent (x 8) with the lowest bits."""
    clipped = np.clip(radiance, 0, _LARGEST)
    brightest = clipped.max(-1)
    smallest = 2.0 ** -(_EXPONENT_BIAS + 1)
    exponent = np.floor(np.log2(np.maximum(brightest, smallest))).astype(np.int64) + 1 + _EXPONENT_BIAS
    # Rounding may need one more bit.
    fits = np.round(brightest / _step_size(exponent)) < 2**_MANTISSA_BITS
    exponent = np.where(fits, exponent, exponent + 1)
    mantissa = np.round(clipped / _step_size(exponent)[..., None]).astype(np.int64)
    lowest = ((mantissa & 1) * [1, 2, 4]).sum(-1)
    return (mantissa >> 1).astype(np.uint8), (exponent * 8 + lowest).astype(np.uint8)[..., None]


def _step_size(exponent: Int[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the difference between neighbouring mantissas."""
    return 2.0 ** (exponent.astype(np.float64) - _EXPONENT_BIAS - _MANTISSA_BITS)
