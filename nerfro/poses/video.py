"""Selection of sharp frames from a video."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nerfro.core.errors import NerfroError
from nerfro.core.progress import track
from nerfro.files.atomic import write_atomically
from nerfro.poses.opencv import opencv


def extract_frames(video: Path, folder: Path, count: int) -> list[Path]:
    """Write the sharpest frame of each of `count` equal parts of a video as `frame_NNNNN.jpg`.

    The number in the name is the number of the frame in the video. Frames that exist are kept, so that an interrupted
    extraction resumes. Frames of another video or of another `count` are deleted.

    Args:
        video: file in any format that OpenCV's FFmpeg reads; its rotation is applied.
        folder: output folder.
        count: number of frames, at least 2.

    Returns:
        The files, in the order of the video.

    Raises:
        NerfroError: the file cannot be read, or has fewer than `count` frames.
    """
    sharpness = _sharpness(video)
    if len(sharpness) < count:
        raise NerfroError(
            f"{video} has {len(sharpness)} readable frames, and frames={count} are asked for; record a longer video, "
            "or reduce frames="
        )
    edges = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    sharpest = {int(first + sharpness[first:last].argmax()) for first, last in itertools.pairwise(edges)}
    files = {number: folder / f"frame_{number:05d}.jpg" for number in sorted(sharpest)}
    folder.mkdir(parents=True, exist_ok=True)
    for file in folder.glob("frame_*.jpg"):
        if file not in files.values() or file.stat().st_mtime_ns < video.stat().st_mtime_ns:
            file.unlink()
    waiting = {number for number, file in files.items() if not file.is_file()}
    for number, frame in enumerate(_frames(video) if waiting else ()):
        if number in waiting:
            _, encoded = opencv().imencode(".jpg", frame, [opencv().IMWRITE_JPEG_QUALITY, 95])
            write_atomically(files[number], encoded.tobytes())
            waiting.remove(number)
        if not waiting:
            break
    return list(files.values())


def _sharpness(video: Path) -> Float[np.ndarray, "F"]:
    """Compute the variance of the Laplacian of each frame, which motion blur reduces."""
    cv2, values = opencv(), []
    capture = _open(video)
    total = int(max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    capture.release()
    for frame in track("finding sharp frames", _frames(video), total=total or None):
        # Sharpness is measured on frames of at most 480 pixels per side.
        scale = min(1.0, 480 / max(frame.shape[:2]))
        size = math.ceil(frame.shape[1] * scale), math.ceil(frame.shape[0] * scale)
        grey = cv2.cvtColor(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        values.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
    return np.array(values)


def _open(video: Path) -> Any:
    """Open a video for decoding."""
    if not video.is_file():
        raise NerfroError(f"video={video} does not exist; give a video file, or images=FOLDER for photographs")
    capture = opencv().VideoCapture(str(video), opencv().CAP_FFMPEG)
    if not capture.isOpened():
        raise NerfroError(f"video={video} cannot be read; give a video file such as .mp4 or .mov")
    return capture


def _frames(video: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Decode a video, BGR."""
    capture = _open(video)
    try:
        while True:
            succeeded, frame = capture.read()
            if not succeeded:
                return
            yield frame
    finally:
        capture.release()
