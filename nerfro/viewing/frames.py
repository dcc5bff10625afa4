"""Frames rendered one after the other, kept as they are done, and gone on with after an interruption."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.cache import content_hash
from nerfro.files.deep_images import write_radiance
from nerfro.files.drawing import GAP, LINE_HEIGHT, fit, paper, write
from nerfro.files.images import save_picture, save_png
from nerfro.viewing.layers import Layer
from nerfro.viewing.render_request import Shots
from nerfro.viewing.sweep import Sweep
from nerfro.viewing.trained_scene import TrainedScene

_RECORD = "frames.json"


@dataclass(frozen=True)
class Rendering:
    """What every frame has in common."""

    scenes: Sequence[TrainedScene]  # shown side by side
    labels: Sequence[str]  # above each, where there are several
    layer: Layer
    sweep: Sweep | None  # what changes over the film

    def picture(self, shots: Shots, frame: int) -> list[tuple[Tensor, Tensor]]:
        """Values as they are, and as sRGB, of one frame in each scene."""
        camera, share = shots.cameras.select([frame]), frame / max(len(shots.names) - 1, 1)
        pictures = []
        for scene in self.scenes:
            changed = scene if self.sweep is None else self.sweep.at(scene, share)
            rendered = self.layer.of(changed).render(camera)
            pictures.append((self.layer.values(rendered)[0], self.layer.shown(rendered, camera)[0]))
        return pictures


def render_frames(
    rendering: Rendering, shots: Shots, folder: Path, suffix: str, request: Sequence[object], overwrite: bool
) -> list[Path]:
    """Render the frames that are not there yet.

    Args:
        rendering: what they show.
        shots: cameras and names.
        folder: where they go; a record of `request` beside them tells frames of this rendering from others.
        suffix: of the frames, .png or .exr.
        request: all that the frames depend on, beside the cameras.
        overwrite: whether frames of another request may be replaced.

    Raises:
        NerfroError: frames of another request lie there and may not be replaced.
    """
    files = [folder / f"{name}{suffix}" for name in shots.names]
    _claim(folder, files, _fingerprint(shots, request), overwrite)
    missing = [frame for frame, file in enumerate(files) if not file.exists()]
    if len(missing) < len(files):
        print(f"nerfro: {len(files) - len(missing)} of {len(files)} frames are there already")
    size = shots.cameras.width * shots.cameras.height * len(rendering.scenes)
    with tqdm(total=len(missing) * size, unit="ray", unit_scale=True, desc="render", dynamic_ncols=True) as progress:
        for frame in missing:
            _write(files[frame], rendering.picture(shots, frame), rendering.labels)
            progress.update(size)
    return files


def _claim(folder: Path, files: Sequence[Path], fingerprint: str, overwrite: bool) -> None:
    """Keep the frames in a folder where they belong to this request, and else remove them if that is allowed."""
    record = folder / _RECORD
    known = json.loads(record.read_text())["request"] if record.is_file() else None
    there = [file for file in files if file.exists()]
    if known != fingerprint:
        if there and not overwrite:
            raise NerfroError(f"{there[0]} shows something else; give another out=... or overwrite=true")
        for file in there:
            file.unlink()
    write_atomically(record, json.dumps({"request": fingerprint}) + "\n")


def _fingerprint(shots: Shots, request: Sequence[object]) -> str:
    cameras = [value.cpu().numpy() if torch.is_tensor(value) else repr(value) for value in vars(shots.cameras).values()]
    return content_hash(*cameras, *shots.names, repr(request))


def _write(file: Path, pictures: list[tuple[Tensor, Tensor]], labels: Sequence[str]) -> None:
    if file.suffix == ".exr":
        write_radiance(file, pictures[0][0].numpy())
    elif len(pictures) == 1:
        save_png(file, pictures[0][1])
    else:
        save_picture(file, _side_by_side([shown for _, shown in pictures], labels))


def _side_by_side(pictures: Sequence[Float[Tensor, "H W 3"]], labels: Sequence[str]) -> Image.Image:
    height, width = pictures[0].shape[:2]
    whole = paper(len(pictures) * (width + GAP) - GAP, height + LINE_HEIGHT)
    for number, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        left = number * (width + GAP)
        whole.paste(fit(picture, width, height), (left, LINE_HEIGHT))
        write(whole, label, left + width // 2, LINE_HEIGHT // 2)
    return whole
