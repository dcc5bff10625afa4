"""Atomic writing of checkpoints."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from nerfro.files.atomic import atomic_file


class CheckpointFiles(TorchCheckpointIO):
    """Write checkpoints of Lightning atomically: the old checkpoint stays until the new one is complete.

    Lightning writes to the temporary folder of the system. If the folder is on another disk, the file is copied over
    the old checkpoint, and a process that is killed during the copy leaves no checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with atomic_file(path) as stream:
            stream.write(content.getbuffer())
