"""Layers of a rendering, rendering of frames, and their encoding as films.

Rendering resumes at the first missing frame after an interruption.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, optional
from nerfro.core.progress import progress_bar
from nerfro.files.atomic import atomic_file, write_atomically, write_json
from nerfro.files.cache import content_hash
from nerfro.files.images import save_png, write_radiance
from nerfro.files.reading import read_json
from nerfro.viewing.render_request import Shots
from nerfro.viewing.trained_scene import RenderedViews, TrainedScene

Images = Float[Tensor, "V H W C"]


@dataclass(frozen=True)
class Layer:
    """A quantity that is rendered.

    Attributes:
        glass, inside: whether the rendered scene contains the glass, and the content of the glass.
        normals: whether the content shows its normals.
        values: values in their units: linear radiance, world units or unit vectors.
        shown: values as sRGB in [0, 1]; depth is scaled to the bounds of the camera's rays.
    """

    glass: bool
    inside: bool
    values: Callable[[RenderedViews], Images]
    shown: Callable[[RenderedViews, Cameras], Images]
    normals: bool = False

    def of(self, scene: TrainedScene) -> TrainedScene:
        """Return the scene with the components of this layer."""
        return scene.with_(glass=self.glass, inside=self.inside, normals=self.normals)


def _grey(values: Float[Tensor, "V H W"]) -> Images:
    return values[..., None].clamp(0, 1).expand(*values.shape, 3)


def _depth_image(rendered: RenderedViews, cameras: Cameras) -> Images:
    """Map depth to grey: near is bright, and pixels of low opacity are black."""
    fraction = (cameras.far - rendered.depth) / (cameras.far - cameras.near)
    return _grey(torch.where(rendered.opacity < 0.5, 0.0, fraction))


def _vector_image(values: Images) -> Images:
    """Map x, y and z of unit vectors from [-1, 1] to red, green and blue in [0, 1]; zero vectors are black."""
    return torch.where((values == 0).all(-1, keepdim=True), 0.0, 0.5 + 0.5 * values).clamp(0, 1)


def _content_normals(rendered: RenderedViews) -> Images:
    """Return the composited normals as unit vectors; zero in pixels of low opacity."""
    return torch.where(rendered.opacity[..., None] < 0.5, 0.0, normalize(rendered.radiance, dim=-1))


def _colours(glass: bool = True, inside: bool = True) -> Layer:
    return Layer(glass, inside, lambda rendered: rendered.radiance, lambda rendered, _: rendered.rgb)


LAYERS = {
    "rgb": _colours(),
    "depth": Layer(True, True, lambda rendered: rendered.depth[..., None], _depth_image),
    "normals": Layer(True, True, lambda r: r.normals, lambda r, _: _vector_image(r.normals)),
    "content_normals": Layer(
        True, True, _content_normals, lambda r, _: _vector_image(_content_normals(r)), normals=True
    ),
    "opacity": Layer(True, True, lambda r: r.opacity[..., None], lambda r, _: _grey(r.opacity)),
    "exits": Layer(True, True, lambda r: r.exit_directions, lambda r, _: _vector_image(r.exit_directions)),
    "glass": _colours(inside=False),
    "inside": _colours(glass=False),
    "sky": _colours(glass=False, inside=False),
}


_RECORD = "frames.json"


def render_frames(
    layer: Layer,
    scene: TrainedScene,
    shots: Shots,
    folder: Path,
    suffix: str,
    request: Sequence[object],
    overwrite: bool,
) -> list[Path]:
    """Render the missing frames.

    Args:
        layer: what each image shows.
        scene: the scene.
        shots: cameras and names.
        folder: output folder; the hash of `request` in this folder identifies the frames of this rendering.
        suffix: ending of the frames, .png or .exr.
        request: everything except the cameras that the frames depend on.
        overwrite: whether frames of another request may be replaced.

    Raises:
        NerfroError: the folder contains frames of another request that must not be replaced.
    """
    files = [folder / f"{name}{suffix}" for name in shots.names]
    _remove_other_frames(folder, files, suffix, _fingerprint(shots, request), overwrite)
    missing = [frame for frame, file in enumerate(files) if not file.exists()]
    if len(missing) < len(files):
        print(f"nerfro: {len(files) - len(missing)} of {len(files)} frames exist already")
    with progress_bar("render", len(missing)) as progress:
        for frame in missing:
            camera = shots.cameras.select([frame])
            rendered = layer.of(scene).render(camera)
            if suffix == ".exr":
                write_radiance(files[frame], layer.values(rendered)[0].numpy())
            else:
                save_png(files[frame], layer.shown(rendered, camera)[0])
            progress.update()
    return files


def _remove_other_frames(folder: Path, files: Sequence[Path], suffix: str, fingerprint: str, overwrite: bool) -> None:
    """Record the request of the frames with a suffix, and remove frames of another request if `overwrite` is set."""
    record = folder / _RECORD
    existing, requests = [file for file in files if file.exists()], _recorded_requests(record)
    if requests.get(suffix) != fingerprint:
        if existing and not overwrite:
            raise NerfroError(f"{existing[0]} belongs to another rendering; give another out=... or overwrite=true")
        for file in existing:
            file.unlink()
    write_json(record, {"requests": {**requests, suffix: fingerprint}})


def _recorded_requests(record: Path) -> dict[str, object]:
    """Return the fingerprints in a record by suffix of the frames; empty if the record is missing or damaged."""
    try:
        return dict(read_json(record, "")["requests"])
    except (NerfroError, KeyError, TypeError, ValueError, IndexError):
        return {}


def _fingerprint(shots: Shots, request: Sequence[object]) -> str:
    cameras = [value.cpu().numpy() if torch.is_tensor(value) else repr(value) for value in vars(shots.cameras).values()]
    return content_hash(*cameras, *shots.names, repr(request))


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
