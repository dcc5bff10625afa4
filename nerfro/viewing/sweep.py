"""Changes of a scene during a film: refractive index, absorption, or a sequence of skies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from nerfro.errors import NerfroError
from nerfro.files.lat_long import load_lat_long
from nerfro.paths import user_path
from nerfro.viewing.trained_scene import TrainedScene


@dataclass(frozen=True)
class Sweep:
    """Change of a scene during a film.

    Attributes:
        at: returns the scene at a fraction of the film, from 0 to 1.
        files: files that the change depends on.
    """

    at: Callable[[TrainedScene, float], TrainedScene]
    files: Sequence[Path] = ()


def read_sweep(text: str) -> Sweep:
    """Parse a sweep: `medium.ior:1.0:1.6`, `medium.absorption:0:2` or `sky:a.hdr,b.hdr`.

    Raises:
        NerfroError: the text has another form, or a sky cannot be read.
    """
    name, _, values = text.partition(":")
    if name == "sky":
        return _sky_sweep([user_path(file) for file in values.split(",") if file])
    try:
        first, last = map(float, values.split(":"))
    except ValueError:
        first = last = math.nan
    if name not in ("medium.ior", "medium.absorption") or not math.isfinite(first + last):
        raise NerfroError(
            f"sweep={text} is not known; give medium.ior:FROM:TO, medium.absorption:FROM:TO, or sky:FILE,FILE"
        )

    def change(scene: TrainedScene, fraction: float) -> TrainedScene:
        value = first + fraction * (last - first)
        return scene.with_(ior=value) if name == "medium.ior" else scene.with_(absorption=[value] * 3)

    return Sweep(change)


def _sky_sweep(files: list[Path]) -> Sweep:
    """Interpolate the linear radiance of skies; smaller skies are enlarged to the size of the largest."""
    if len(files) < 2:
        raise NerfroError("sweep=sky:... needs two skies or more; write sky:a.hdr,b.hdr")
    images = [load_lat_long(file).permute(2, 0, 1)[None] for file in files]
    height = max(image.shape[2] for image in images)
    size = height, 2 * height
    skies = [torch.nn.functional.interpolate(image, size, mode="bilinear")[0].permute(1, 2, 0) for image in images]

    def change(scene: TrainedScene, fraction: float) -> TrainedScene:
        position = fraction * (len(skies) - 1)
        before = min(int(position), len(skies) - 2)
        return scene.with_(sky=torch.lerp(skies[before], skies[before + 1], position - before))

    return Sweep(change, files)
