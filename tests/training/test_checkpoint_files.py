"""Checkpoints are whole, wherever the system keeps its temporary files."""

import errno
import os
import tempfile
from pathlib import Path

import pytest
import torch

from nerfro.errors import NerfroError
from nerfro.training.checkpoint_files import CheckpointFiles


def test_checkpoint_is_written_beside_the_old_one_and_not_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    for number in (1, 2):
        CheckpointFiles().save_checkpoint({"step": number}, tmp_path / "run" / "last.ckpt")
        assert torch.load(tmp_path / "run" / "last.ckpt", weights_only=True) == {"step": number}
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_full_disk_leaves_the_old_checkpoint(step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    CheckpointFiles().save_checkpoint({"step": 1}, tmp_path / "last.ckpt")

    def fail(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(NerfroError, match=r"last\.ckpt: No space left on device"):
        CheckpointFiles().save_checkpoint({"step": 2}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt", weights_only=True) == {"step": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
