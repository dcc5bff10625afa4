"""Rendering of frames one by one; an interrupted rendering resumes at the first missing frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.cache import content_hash
from nerfro.files.deep_images import write_radiance
from nerfro.files.drawing import sheet
from nerfro.files.images import save_image, save_png
from nerfro.files.reading import read_json
from nerfro.progress import progress_bar
from nerfro.viewing.layers import Layer
from nerfro.viewing.render_request import Shots
from nerfro.viewing.trained_scene import TrainedScene

_RECORD = "frames.json"


@dataclass(frozen=True)
class FrameRenderer:
    """Renders the frames of a film.

    Attributes:
        scenes: scenes that are shown side by side.
        labels: label of each scene, for several scenes.
        layer: what each image shows.
    """

    scenes: Sequence[TrainedScene]
    labels: Sequence[str]
    layer: Layer

    def render(self, shots: Shots, frame: int) -> list[tuple[Tensor, Tensor]]:
        """Render a frame of each scene: values in their units, and the sRGB image."""
        camera = shots.cameras.select([frame])
        images = []
        for scene in self.scenes:
            rendered = self.layer.of(scene).render(camera)
            images.append((self.layer.values(rendered)[0], self.layer.shown(rendered, camera)[0]))
        return images


def render_frames(
    renderer: FrameRenderer, shots: Shots, folder: Path, suffix: str, request: Sequence[object], overwrite: bool
) -> list[Path]:
    """Render the missing frames.

    Args:
        renderer: renders each frame.
        shots: cameras and names.
        folder: output folder; the hash of `request` in this folder identifies the frames of this rendering.
        suffix: ending of the frames, .png or .exr.
        request: everything except the cameras that the frames depend on.
        overwrite: whether frames of another request may be replaced.

    Raises:
        NerfroError: the folder contains frames of another request that must not be replaced.
    """
    files = [folder / f"{name}{suffix}" for name in shots.names]
    _remove_other_frames(folder, files, _fingerprint(shots, request), overwrite)
    missing = [frame for frame, file in enumerate(files) if not file.exists()]
    if len(missing) < len(files):
        print(f"nerfro: {len(files) - len(missing)} of {len(files)} frames exist already")
    with progress_bar("render", len(missing)) as progress:
        for frame in missing:
            _write(files[frame], renderer.render(shots, frame), renderer.labels)
            progress.update()
    return files


def _remove_other_frames(folder: Path, files: Sequence[Path], fingerprint: str, overwrite: bool) -> None:
    """Record the request in the folder, and remove frames of another request if `overwrite` is set."""
    record = folder / _RECORD
    existing = [file for file in files if file.exists()]
    if _recorded_request(record) != fingerprint:
        if existing and not overwrite:
            raise NerfroError(f"{existing[0]} belongs to another rendering; give another out=... or overwrite=true")
        for file in existing:
            file.unlink()
    write_atomically(record, json.dumps({"request": fingerprint}) + "\n")


def _recorded_request(record: Path) -> object:
    """Return the fingerprint in a record; None if the record is missing or damaged."""
    try:
        return read_json(record, "")["request"]
    except (NerfroError, KeyError, TypeError, IndexError):
        return None


def _fingerprint(shots: Shots, request: Sequence[object]) -> str:
    cameras = [value.cpu().numpy() if torch.is_tensor(value) else repr(value) for value in vars(shots.cameras).values()]
    return content_hash(*cameras, *shots.names, repr(request))


def _write(file: Path, images: list[tuple[Tensor, Tensor]], labels: Sequence[str]) -> None:
    if file.suffix == ".exr":
        write_radiance(file, images[0][0].numpy())
    elif len(images) == 1:
        save_png(file, images[0][1])
    else:
        shown = [image for _, image in images]
        save_image(file, sheet(shown, labels, shown[0].shape[1], len(shown)))
