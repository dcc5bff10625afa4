"""Films of frames that are already written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nerfro.files.atomic import atomic_file, write_atomically

# Constant quality of H.264: 0 is lossless, 18 hardly told from it, 51 the worst.
_QUALITY = 18


def write_film(file: Path, frames: Sequence[Path], seconds: float) -> None:
    """Write frames (.png) as .mp4 (H.264, plays everywhere) or as .gif that begins again for ever."""
    writer = {".mp4": _write_mp4, ".gif": _write_gif}[file.suffix]
    writer(file, frames, len(frames) / seconds)


def _write_mp4(file: Path, frames: Sequence[Path], rate: float) -> None:
    # Brings its own encoder.
    from imageio_ffmpeg import write_frames

    first = _even(_pixels(frames[0]))
    options = ["-crf", str(_QUALITY), "-movflags", "+faststart"]
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder, file.name)
        sink = write_frames(
            made, first.shape[1::-1], fps=rate, codec="libx264", quality=None, macro_block_size=2,
            ffmpeg_log_level="error", output_params=options,
        )  # fmt: skip
        sink.send(None)
        try:
            for frame in frames:
                sink.send(np.ascontiguousarray(_even(_pixels(frame))))
        finally:
            sink.close()
        write_atomically(file, made.read_bytes())


def _write_gif(file: Path, frames: Sequence[Path], rate: float) -> None:
    pictures = _palettes(frames)
    # The format counts in hundredths of a second, and viewers do not go below two.
    duration = max(20, 10 * round(100 / rate))
    with atomic_file(file) as stream:
        next(pictures).save(stream, "GIF", save_all=True, append_images=pictures, duration=duration, loop=0)


def _palettes(frames: Sequence[Path]) -> Iterator[Image.Image]:
    """Frames with 256 colours each: those of the first alone would be wrong where a film changes."""
    for frame in frames:
        with Image.open(frame) as picture:
            yield picture.convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG)


def _pixels(frame: Path) -> UInt8[np.ndarray, "H W 3"]:
    with Image.open(frame) as picture:
        return np.array(picture.convert("RGB"))


def _even(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """With the last row and column twice where there is an odd number: colours of .mp4 are of two by two pixels."""
    return np.pad(pixels, ((0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)), mode="edge")
