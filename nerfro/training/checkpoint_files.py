"""Checkpoints, written like every other file: whole or not at all, and only where a run still is."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from nerfro.files.atomic import atomic_file


class CheckpointFiles(TorchCheckpointIO):
    """Lightning's checkpoints, of which the old one stays until the new one is whole.

    Lightning writes to the system's temporary folder. Where that is on another disk, the file is then copied over the
    old checkpoint, and a process that is killed meanwhile leaves neither.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with atomic_file(path) as stream:
            stream.write(content.getbuffer())
