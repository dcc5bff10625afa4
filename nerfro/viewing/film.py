"""Encoding of rendered frames as films."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nerfro.core.errors import NerfroError
from nerfro.core.optional import optional
from nerfro.files.atomic import atomic_file, write_atomically


def write_film(file: Path, frames: Sequence[Path], seconds: float) -> None:
    """Encode frames as a film.

    Args:
        file: output, .mp4 (H.264) or .gif (endless loop).
        frames: PNG files in order.
        seconds: duration of the film.

    Raises:
        NerfroError: no ffmpeg is installed, or encoding fails.
    """
    writer = {".mp4": _write_mp4, ".gif": _write_gif}[file.suffix]
    writer(file, frames, seconds)


def find_ffmpeg() -> str:
    """Return the path of ffmpeg: the one of the system, or the one of the package imageio-ffmpeg.

    Raises:
        NerfroError: neither is installed.
    """
    if (path := shutil.which("ffmpeg")) is not None:
        return path
    purpose = "a film in .mp4 format needs ffmpeg"
    try:
        return optional("imageio_ffmpeg", "video", purpose).get_ffmpeg_exe()
    except (NerfroError, RuntimeError) as error:
        raise NerfroError(
            f"{purpose}, which is not installed; install ffmpeg, or pip install 'nerfro[video]', or set film=[gif] or "
            "film=[]"
        ) from error


def _write_mp4(file: Path, frames: Sequence[Path], seconds: float) -> None:
    (height, width), rate = _read_even(frames[0]).shape[:2], len(frames) / seconds
    with tempfile.TemporaryDirectory() as folder:
        encoded = Path(folder, file.name)
        pixels = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate), "-i", "-"]
        # Constant rate factor of H.264: 0 is lossless, 18 is visually lossless, 51 is the worst.
        options = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-movflags", "+faststart"]
        command = [find_ffmpeg(), "-loglevel", "error", *pixels, *options, str(encoded)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # ffmpeg has failed, and its message says why
                for frame in frames:
                    process.stdin.write(_read_even(frame).tobytes())
            messages = process.communicate()[1].decode(errors="replace").strip().splitlines()
        if process.returncode:
            reason = messages[-1:] or ["no message"]
            raise NerfroError(f"ffmpeg cannot write {file.name} ({reason[0]}); set film=[gif] or film=[]")
        write_atomically(file, encoded.read_bytes())


def _write_gif(file: Path, frames: Sequence[Path], seconds: float) -> None:
    # The unit of the format is a hundredth of a second, and viewers replace durations below two units. The ends of the
    # frames are rounded and not the durations, whose errors would add up.
    num_shown = max(1, min(len(frames), int(100 * seconds / 2)))
    ends = np.round(100 * seconds * np.arange(num_shown + 1) / num_shown).astype(int)
    images = _quantized([frames[i * len(frames) // num_shown] for i in range(num_shown)])
    durations = [10 * int(duration) for duration in np.diff(ends)]  # milliseconds
    with atomic_file(file) as stream:
        next(images).save(stream, "GIF", save_all=True, append_images=images, duration=durations, loop=0)


def _quantized(frames: Sequence[Path]) -> Iterator[Image.Image]:
    """Reduce each frame to a palette of 256 colours of its own, because the colours of a film change."""
    for frame in frames:
        with Image.open(frame) as image:
            yield image.convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG)


def _read_even(frame: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Read a frame and repeat the last row and column if their number is odd, because H.264 needs even sizes."""
    with Image.open(frame) as image:
        pixels = np.array(image.convert("RGB"))
    return np.pad(pixels, ((0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)), mode="edge")
