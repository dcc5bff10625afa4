"""Progress of long work before training."""

from pathlib import Path

import pytest

from nerfro.core import progress
from tests.conftest import Runner


def test_long_renderings_and_grids_have_progress_bars(
    train_paper: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for delay, has_bars in ((1e9, False), (0, True)):
        monkeypatch.setattr(progress, "DELAY", delay)
        run = f"hydra.run.dir={tmp_path / str(delay)}"
        finished = train_paper("trainer.max_steps=1", "evaluation.every=0", run)
        for work in ("reading", "occupancy"):
            assert (f"{work}: 100%" in finished.err) == has_bars


def test_log_file_receives_whole_lines_once_per_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for seconds, num_lines in ((60.0, 2), (0.0, 4)):  # the first and the last state, or all of them
        monkeypatch.setattr(progress, "_LOG_SECONDS", seconds)
        monkeypatch.setattr(progress, "DELAY", 0)
        assert list(progress.track("counting", [1, 2, 3])) == [1, 2, 3]
        lines = capsys.readouterr().err.splitlines(keepends=True)
        assert len(lines) == num_lines
        assert all(line.startswith("counting: ") and line.endswith("\n") and "\r" not in line for line in lines)
        assert lines[-1].startswith("counting: 100%")
        bar = progress.progress_bar("counting", 9)
        bar.update(9)
        assert bar.miniters <= 1  # otherwise tqdm's monitor thread adds a line ten seconds after each line
        bar.close()
        capsys.readouterr()
