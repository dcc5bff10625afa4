"""Work that may take long before training starts says how far it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nerfro import progress


def test_pictures_and_grids_have_bars_once_they_take_long(
    train_here: Callable[..., Any], tiny_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = [*tiny_run, "trainer.max_steps=1", "evaluation.every=0"]
    for delay, has_bars in ((1e9, False), (0, True)):
        monkeypatch.setattr(progress, "DELAY", delay)
        finished = train_here(*run, f"hydra.run.dir={tmp_path / str(delay)}")
        assert finished.code == 0, finished.err
        for work in ("reading", "occupancy", "smoothing"):
            assert (f"{work}: 100%" in finished.err) == has_bars
