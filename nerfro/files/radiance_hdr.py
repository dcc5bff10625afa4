"""Radiance's .hdr pictures: a text header and four bytes a pixel, three mantissas and a common exponent.

Source: Ward, Real Pixels, Graphics Gems II, 1991, and the file format's page of the Radiance manual.
"""

from __future__ import annotations

import numpy as np

# Scanlines of these widths may be run-length encoded.
_MIN_RUN_WIDTH, _MAX_RUN_WIDTH = 8, 32767


def encode(linear: np.ndarray) -> bytes:
    """The file of a picture.

    Args:
        linear: radiance [H, W, 3], not negative, at most 1e38.
    """
    height, width = linear.shape[:2]
    brightest = linear.max(-1)
    mantissa, exponent = np.frexp(brightest)
    scale = np.where(brightest > 1e-32, mantissa * 256 / np.maximum(brightest, 1e-32), 0)
    pixels = np.empty((height, width, 4), np.uint8)
    pixels[..., :3] = np.clip(linear * scale[..., None], 0, 255)
    pixels[..., 3] = np.where(brightest > 1e-32, exponent + 128, 0)
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    if not _MIN_RUN_WIDTH <= width <= _MAX_RUN_WIDTH:
        return header + pixels.tobytes()
    # Run-length encoding with literal runs only: flat pixels would be mistaken for old-style runs by some readers.
    start = bytes((2, 2, width >> 8, width & 255))
    lines = []
    for line in pixels:
        parts = (line[at : at + 128, channel].tobytes() for channel in range(4) for at in range(0, width, 128))
        lines.append(start + b"".join(bytes((len(part),)) + part for part in parts))
    return header + b"".join(lines)


def decode(content: bytes) -> np.ndarray:
    """Linear radiance [H, W, 3] of a file, float32.

    Raises:
        ValueError: it is not a Radiance picture of the usual orientation, or it is cut short.
    """
    header, separator, rest = content.partition(b"\n\n")
    if not content.startswith(b"#?") or not separator or b"32-bit_rle_rgbe" not in header:
        raise ValueError("not a Radiance RGBE picture")
    size, _, body = rest.partition(b"\n")
    words = size.split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X":
        raise ValueError(f"orientation {size[:40]!r}; only -Y H +X W is read")
    height, width = int(words[1]), int(words[3])
    encoded = _MIN_RUN_WIDTH <= width <= _MAX_RUN_WIDTH and body[:2] == b"\x02\x02" and body[2] < 128
    if encoded:
        pixels = _decode_runs(body, height, width)
    elif len(body) >= 4 * height * width:
        pixels = np.frombuffer(body, np.uint8, 4 * height * width).reshape(height, width, 4)
    else:
        raise ValueError("the file is cut short")
    scale = np.where(pixels[..., 3] > 0, np.ldexp(1.0, pixels[..., 3].astype(np.int32) - 136), 0)
    return ((pixels[..., :3] + 0.5) * scale[..., None]).astype(np.float32)


def _decode_runs(body: bytes, height: int, width: int) -> np.ndarray:
    pixels = np.empty((height, 4, width), np.uint8)
    at = 0
    for row in range(height):
        if body[at : at + 2] != b"\x02\x02" or int.from_bytes(body[at + 2 : at + 4], "big") != width:
            raise ValueError(f"scanline {row} is damaged or cut short")
        at += 4
        for channel in range(4):
            column = 0
            while column < width:
                if at + 1 >= len(body):
                    raise ValueError("the file is cut short")
                count = body[at]
                repeated = count > 128
                count = count - 128 if repeated else count
                part = body[at + 1 : at + 2] * count if repeated else body[at + 1 : at + 1 + count]
                if count == 0 or len(part) != count or column + count > width:
                    raise ValueError(f"scanline {row} is damaged or cut short")
                pixels[row, channel, column : column + count] = np.frombuffer(part, np.uint8)
                column += count
                at += 2 if repeated else 1 + count
    return pixels.transpose(0, 2, 1)
