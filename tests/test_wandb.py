"""Weights & Biases without an account: a run is logged into its own folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.slow
def test_offline_run_needs_no_account(
    train_here: Callable[..., Any], tiny_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    folder = tmp_path / "run"
    finished = train_here(
        *tiny_run, "logger=wandb", "logger.wandb.offline=true", "trainer.max_steps=4", "evaluation.every=2",
        "trainer.log_every_n_steps=1", f"hydra.run.dir={folder}",
    )  # fmt: skip
    assert finished.code == 0, finished.err
    (log,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    content = log.read_bytes()
    for key in (b"loss/photometric", b"weight/boundary", b"val/psnr"):
        assert key in content
