"""Rendering of frames one by one; an interrupted rendering resumes at the first missing frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch

from nerfro.core.errors import NerfroError
from nerfro.core.progress import progress_bar
from nerfro.files.atomic import write_atomically
from nerfro.files.cache import content_hash
from nerfro.files.deep_images import write_radiance
from nerfro.files.images import save_png
from nerfro.files.reading import read_json
from nerfro.viewing.layers import Layer
from nerfro.viewing.render_request import Shots
from nerfro.viewing.trained_scene import TrainedScene

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
    write_atomically(record, json.dumps({"requests": {**requests, suffix: fingerprint}}) + "\n")


def _recorded_requests(record: Path) -> dict[str, object]:
    """Return the fingerprints in a record by suffix of the frames; empty if the record is missing or damaged."""
    try:
        return dict(read_json(record, "")["requests"])
    except (NerfroError, KeyError, TypeError, ValueError, IndexError):
        return {}


def _fingerprint(shots: Shots, request: Sequence[object]) -> str:
    cameras = [value.cpu().numpy() if torch.is_tensor(value) else repr(value) for value in vars(shots.cameras).values()]
    return content_hash(*cameras, *shots.names, repr(request))
