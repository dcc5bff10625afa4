"""Checkpoints are whole, wherever the system keeps its temporary files."""

import tempfile
from pathlib import Path

import pytest
import torch

from nerfro.training.checkpoint_files import CheckpointFiles


def test_checkpoint_is_written_beside_the_old_one_and_not_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    for number in (1, 2):
        CheckpointFiles().save_checkpoint({"step": number}, tmp_path / "run" / "last.ckpt")
        assert torch.load(tmp_path / "run" / "last.ckpt", weights_only=True) == {"step": number}
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["last.ckpt"]
