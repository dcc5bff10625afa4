"""Scenes that change over the frames of a film: an index from air to glass, one sky into the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.files.lat_long import load_lat_long
from nerfro.paths import user_path
from nerfro.viewing.trained_scene import TrainedScene


@dataclass(frozen=True)
class Sweep:
    """Something that changes over a film."""

    at: Callable[[TrainedScene, float], TrainedScene]  # the scene at a share of the film, from 0 to 1
    files: Sequence[Path] = ()  # what it is read from


_NUMBERS = {"medium.ior": "ior", "medium.absorption": "absorption"}


def read_sweep(text: str) -> Sweep:
    """A sweep as it is written: `medium.ior:1.0:1.6`, `medium.absorption:0:2` or `sky:a.hdr,b.hdr`.

    Raises:
        NerfroError: it is none of these, or a sky cannot be read.
    """
    name, _, values = text.partition(":")
    if name == "sky":
        return _between_skies([user_path(place) for place in values.split(",") if place])
    ends = values.split(":")
    if name not in _NUMBERS or len(ends) != 2 or not all(map(_is_number, ends)):
        known = ", ".join(f"{number}:FROM:TO" for number in _NUMBERS)
        raise NerfroError(f"sweep={text} is not known; give {known}, or sky:FILE,FILE")
    first, last = map(float, ends)

    def change(scene: TrainedScene, share: float) -> TrainedScene:
        value = first + share * (last - first)
        return scene.with_(ior=value) if name == "medium.ior" else scene.with_(absorption=[value] * 3)

    return Sweep(change)


def _between_skies(files: list[Path]) -> Sweep:
    """Skies that turn into each other; light adds, so that halfway both shine with half their radiance."""
    if len(files) < 2:
        raise NerfroError("sweep=sky:... needs two skies or more; write sky:a.hdr,b.hdr")
    skies = [load_lat_long(file) for file in files]
    height = max(len(sky) for sky in skies)
    skies = [_enlarged(sky, height) for sky in skies]

    def change(scene: TrainedScene, share: float) -> TrainedScene:
        place = share * (len(skies) - 1)
        before = min(int(place), len(skies) - 2)
        return scene.with_(sky=torch.lerp(skies[before], skies[before + 1], place - before))

    return Sweep(change, files)


def _enlarged(sky: Float[Tensor, "h w 3"], height: int) -> Float[Tensor, "H 2*H 3"]:
    picture = sky.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(picture, (height, 2 * height), mode="bilinear")[0].permute(1, 2, 0)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
