"""The 16-bit PNG reader against an encoder written here and against libpng."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from nerfro.files.png16 import PngError, decode_png16, is_png16

COLOUR_TYPE = {1: 0, 2: 4, 3: 2, 4: 6}


def encode_png16(levels: np.ndarray, filters: list[int], interlaced: int = 0) -> bytes:
    """Encode [H, W, C] levels with a filter for each row, byte by byte."""
    height, width, num_channels = levels.shape
    pixel_bytes = 2 * num_channels
    raw = levels.astype(">u2").reshape(height, -1).view(np.uint8).astype(int)
    stream = bytearray()
    for i, kind in enumerate(filters):
        stream.append(kind)
        for j, value in enumerate(raw[i]):
            left = raw[i][j - pixel_bytes] if j >= pixel_bytes else 0
            above = raw[i - 1][j] if i else 0
            corner = raw[i - 1][j - pixel_bytes] if i and j >= pixel_bytes else 0
            guess = left + above - corner
            paeth = min((left, above, corner), key=lambda neighbour: abs(guess - neighbour))
            stream.append((value - (0, left, above, (left + above) // 2, paeth)[kind]) % 256)
    header = struct.pack(">IIBBBBB", width, height, 16, COLOUR_TYPE[num_channels], 0, 0, interlaced)
    compressed = zlib.compress(bytes(stream))
    # The pixels are split over two chunks, as encoders do with large images.
    parts = [(b"IHDR", header), (b"IDAT", compressed[:20]), (b"IDAT", compressed[20:]), (b"IEND", b"")]
    chunks = (struct.pack(">I", len(p)) + k + p + struct.pack(">I", zlib.crc32(k + p)) for k, p in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def picture(num_channels: int) -> np.ndarray:
    """A smooth ramp with noise, so that the Paeth filter takes each of its branches."""
    generator = np.random.default_rng(num_channels)
    ramp = np.add.outer(np.arange(10) * 3000, np.arange(7) * 2000)[..., None]
    return ((ramp + generator.integers(0, 9000, (10, 7, num_channels))) % 65536).astype(np.uint16)


@pytest.mark.parametrize("num_channels", [1, 2, 3, 4])
@pytest.mark.parametrize("filters", [[0] * 10, [1] * 10, [2] * 10, [3] * 10, [4] * 10, [4, 3, 2, 1, 0, 0, 1, 2, 3, 4]])
def test_every_filter_and_colour_type_is_decoded_exactly(num_channels, filters):
    levels = picture(num_channels)
    content = encode_png16(levels, filters)
    assert is_png16(content)
    np.testing.assert_array_equal(decode_png16(content), levels)


@pytest.mark.parametrize("num_channels", [1, 3, 4])
def test_files_written_by_libpng_are_decoded_exactly(num_channels, tmp_path: Path):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    levels = picture(num_channels)
    mitsuba.Bitmap(levels).write(str(tmp_path / "picture.png"))
    np.testing.assert_array_equal(decode_png16((tmp_path / "picture.png").read_bytes()), levels)


def test_8bit_png_and_other_files_are_not_16bit():
    content = bytearray(encode_png16(picture(3), [0] * 10))
    content[24] = 8
    assert not is_png16(bytes(content))
    assert not is_png16(b"")
    assert not is_png16(b"\xff\xd8\xff" + bytes(40))


@pytest.mark.parametrize("kept", [30, 60, -13, -3])
def test_truncated_file_is_refused(kept):
    with pytest.raises(PngError, match="truncated"):
        decode_png16(encode_png16(picture(3), [0] * 10)[:kept])


def test_flipped_bit_is_found_by_the_checksum():
    content = bytearray(encode_png16(picture(3), [0] * 10))
    content[50] ^= 1
    with pytest.raises(PngError, match="checksum of its IDAT chunk"):
        decode_png16(bytes(content))


def test_interlaced_file_is_refused():
    with pytest.raises(PngError, match="interlaced"):
        decode_png16(encode_png16(picture(3), [0] * 10, interlaced=1))


def test_missing_rows_are_refused():
    content = encode_png16(picture(3), [0] * 9)
    with pytest.raises(PngError, match="7x10"):
        decode_png16(content)


def test_unknown_filter_is_refused():
    levels = np.zeros((2, 3, 1), np.uint16)
    content = bytearray(encode_png16(levels, [0, 0]))
    stream = zlib.compress(b"\5" + bytes(6) + b"\0" + bytes(6))
    chunk = struct.pack(">I", len(stream)) + b"IDAT" + stream + struct.pack(">I", zlib.crc32(b"IDAT" + stream))
    with pytest.raises(PngError, match="unknown filter"):
        decode_png16(bytes(content[:33]) + chunk + bytes(content[-12:]))
