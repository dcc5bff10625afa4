"""Reader of 16-bit PNG files; Pillow reduces those of more than one channel to 8 bits without a word."""

from __future__ import annotations

import functools
import inspect
import struct
import zlib
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import UInt16

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_NUM_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by PNG colour type; a palette (3) has at most 8 bits


class PngError(ValueError):
    """What is wrong with a PNG file's content."""


def is_png16(content: bytes) -> bool:
    """Whether a file's first bytes are those of a PNG with 16 bits per channel."""
    return content.startswith(_SIGNATURE) and len(content) > 24 and content[24] == 16


def decode_png16(content: bytes) -> UInt16[np.ndarray, "H W C"]:
    """Decode a 16-bit PNG file (W3C Portable Network Graphics, sections 5, 7.2 and 9).

    Args:
        content: the whole file.

    Returns:
        Levels 0 to 65535; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGBA).

    Raises:
        PngError: the content is truncated or corrupt, or interlaced, which is not supported.
    """
    header, compressed = b"", []
    for kind, chunk in _chunks(content):
        if kind == b"IHDR":
            header = chunk
        elif kind == b"IDAT":
            compressed.append(chunk)
    if len(header) != 13:
        raise PngError("its header is missing")
    width, height, depth, colour_type, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    if interlaced:
        raise PngError("it is interlaced, which 16-bit images must not be; save it again without interlacing")
    if depth != 16 or colour_type not in _NUM_CHANNELS:
        raise PngError(f"it has bit depth {depth} and colour type {colour_type}")
    num_channels = _NUM_CHANNELS[colour_type]
    try:
        data = zlib.decompress(b"".join(compressed))
    except zlib.error as error:
        raise PngError(f"its pixels cannot be decompressed: {error}") from error
    pixel_bytes = 2 * num_channels
    if len(data) != height * (1 + width * pixel_bytes):
        raise PngError(f"it holds {len(data)} bytes of pixels where {width}x{height} need another number")
    rows = np.frombuffer(bytearray(data), np.uint8).reshape(height, -1)
    if rows[:, 0].max() > 4:
        raise PngError("one of its rows has an unknown filter")
    _compiled_unfilter()(rows, pixel_bytes)
    return rows[:, 1:].copy().view(">u2").astype(np.uint16).reshape(height, width, num_channels)


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    position = len(_SIGNATURE)
    while True:
        if position + 12 > len(content):
            raise PngError("it is truncated")
        length, kind = struct.unpack_from(">I4s", content, position)
        chunk = content[position + 8 : position + 8 + length]
        position += 12 + length
        if position > len(content):
            raise PngError("it is truncated")
        if struct.unpack_from(">I", content, position - 4)[0] != zlib.crc32(kind + chunk):
            raise PngError(f"the checksum of its {kind.decode('latin1')} chunk is wrong")
        if kind == b"IEND":
            return
        yield kind, chunk


@functools.cache
def _compiled_unfilter() -> Callable[[np.ndarray, int], None]:
    # Imported here: most data sets have 8 bits and need no compiler.
    import numba

    return numba.njit(inspect.unwrap(_unfilter), nogil=True, cache=True)


def _unfilter(rows: np.ndarray, pixel_bytes: int) -> None:
    """Undo each row's filter in place; rows [H, 1 + bytes] begin with the filter's type.

    A byte is predicted from those of the pixel to the left (a), above (b) and above left (c), each 0 outside the image.
    """
    height, row_bytes = rows.shape
    for i in range(height):
        kind = rows[i, 0]
        for j in range(1, row_bytes):
            a = int(rows[i, j - pixel_bytes]) if j > pixel_bytes else 0
            b = int(rows[i - 1, j]) if i > 0 else 0
            c = int(rows[i - 1, j - pixel_bytes]) if i > 0 and j > pixel_bytes else 0
            if kind == 1:
                prediction = a
            elif kind == 2:
                prediction = b
            elif kind == 3:
                prediction = (a + b) // 2
            elif kind == 4:  # Paeth: whichever of a, b, c is nearest to a + b - c
                to_a, to_b, to_c = abs(b - c), abs(a - c), abs(a + b - 2 * c)
                if to_a <= to_b and to_a <= to_c:
                    prediction = a
                elif to_b <= to_c:
                    prediction = b
                else:
                    prediction = c
            else:
                prediction = 0
            rows[i, j] = (int(rows[i, j]) + prediction) & 255
