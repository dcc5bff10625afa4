"""Runs that are killed, interrupted and resumed, also from a wrong checkpoint."""

import contextlib
import csv
import itertools
import os
import shutil
import signal
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest
import torch

from nerfro.core.errors import NerfroError
from nerfro.evaluation import scoring
from nerfro.files.images import save_png
from nerfro.training.run_folder import (
    LAST_CHECKPOINT,
    find_checkpoint,
    load_checkpoint,
)
from tests.conftest import Bomb, Runner, refused
from tests.forked import Command

SCHEDULE = ["checkpoint.every_steps=3", "checkpoint.every_seconds=null", "evaluation.every=5", "trainer.max_steps=12"]


@pytest.fixture
def start(tmp_path: Path, waiting_plugins: str, tiny_run: list[str]) -> Callable[..., Command]:
    """Start a training process with a loss that waits; its folder is tmp_path/<name>."""
    number = itertools.count()

    def start(name: str, *overrides: str) -> Command:
        options = [*tiny_run, *SCHEDULE, "+loss.waiting.weight=1", f"hydra.run.dir={tmp_path / name}", *overrides]
        return Command("train", options, tmp_path / f"log_{next(number)}", NERFRO_PLUGINS=waiting_plugins)

    return start


def log_rows(file: Path) -> list[dict[str, str]]:
    """Rows of a CSV log, without empty cells."""
    with file.open(newline="") as stream:
        return [{name: value for name, value in row.items() if value} for row in csv.DictReader(stream)]


@pytest.mark.slow
def test_interrupted_run_is_saved_and_prints_how_to_resume(start: Callable[..., Command], tmp_path: Path) -> None:
    process = start("run", "trainer.max_steps=500", "checkpoint.every_steps=400")
    process.until("^at step 4$")
    process.send(signal.SIGINT)
    assert process.wait() == 130, process.errors
    assert "Traceback" not in process.errors
    steps = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)[0]["global_step"]
    assert 4 <= steps <= 8
    assert f"nerfro: interrupted after step {steps} and saved\n" in process.printed
    advice = f"hydra.run.dir={tmp_path / 'run'} ckpt_path=last"
    assert process.errors.endswith(f"nerfro: interrupted; to resume, repeat the command with {advice}\n")
    # What the message says works, and goes on from there.
    resumed = start("run", f"trainer.max_steps={steps + 2}", "checkpoint.every_steps=400", "ckpt_path=last")
    out = resumed.finished()
    seen = [int(line.rsplit(" ", 1)[1]) for line in out.splitlines() if line.startswith("at step")]
    assert seen == [steps, steps + 1]


@contextlib.contextmanager
def interrupted_at_second_picture() -> Iterator[None]:
    """Ctrl-C when one test view has been rendered and written, and another one not."""
    count = itertools.count(1)

    def save(path: Path, rgb: torch.Tensor) -> None:
        if next(count) == 2:
            signal.raise_signal(signal.SIGINT)
        save_png(path, rgb)

    with mock.patch.object(scoring, "save_png", save):
        yield


def test_interrupted_evaluation_prints_how_to_continue(
    train_paper: Runner, evaluate_here: Runner, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    training = ["trainer.max_steps=2", "evaluation.every=0"]
    with interrupted_at_second_picture():
        finished = train_paper(*training, code=130)
    advice = f"hydra.run.dir={run} ckpt_path=last"
    assert finished.err.splitlines()[-1] == f"nerfro: interrupted; to resume, repeat the command with {advice}"
    assert not (run / "metrics.json").exists()
    # What the message says works.
    train_paper(*training, *advice.split())
    assert (run / "metrics.json").exists()

    scored = [f"checkpoint={run / LAST_CHECKPOINT}", f"out={tmp_path / 'scores'}"]
    with interrupted_at_second_picture():
        stopped = evaluate_here(*scored, code=130)
    assert stopped.err.splitlines()[-1] == "nerfro: interrupted; run the same command to start again"
    assert not (tmp_path / "scores" / "metrics.json").exists()
    evaluate_here(*scored)
    assert (tmp_path / "scores" / "metrics.json").exists()


def test_resuming_a_finished_run_with_more_steps_trains_the_rest(
    train: Runner, trained_run: Path, tmp_path: Path
) -> None:
    shutil.copytree(trained_run, tmp_path / "run")
    shutil.copytree(trained_run, tmp_path / "run" / "evaluate_test")
    assert list((tmp_path / "run").glob("metrics.*"))
    log = tmp_path / "run" / "csv" / "metrics.csv"
    rows = log_rows(log)
    lost = [rows[0] | {"step": str(step)} for step in (2, 3)]  # of a process that was killed after its checkpoint
    with log.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, sorted({name for row in rows for name in row}))
        writer.writeheader()
        writer.writerows([*rows, *lost])
    options = ["evaluation.every=0", "evaluation.split=null", "trainer.max_steps=5", "ckpt_path=last"]
    train(*options, "logger=tensorboard", "trainer.log_every_n_steps=1")
    assert log_rows(log)[: len(rows)] == rows, "the log keeps its earlier rows"
    trained = [row["step"] for row in log_rows(log) if "loss/total" in row]
    assert trained == sorted(set(trained), key=int)
    assert set(trained) >= {"2", "3", "4"}
    checkpoint, _ = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)
    assert checkpoint["global_step"] == 5
    assert checkpoint["callbacks"]["Throughput"]["num_rays"] >= 5 * 32
    scores = list((tmp_path / "run").rglob("metrics.json"))
    assert not scores, "a table would show the scores of fewer steps beside the new budget"


def test_resuming_with_fewer_steps_than_the_checkpoint_has_is_refused(
    train: Runner, trained_run: Path, tmp_path: Path
) -> None:
    shutil.copytree(trained_run, tmp_path / "run")
    before = (tmp_path / "run" / "config.yaml").read_text()
    refused = train("evaluation.every=0", "trainer.max_steps=1", "ckpt_path=last", code=1)
    assert "steps, and trainer.max_steps=1; give at least" in refused.error
    assert (tmp_path / "run" / "config.yaml").read_text() == before


def test_last_finds_the_newest_run_beside_a_new_folder(tmp_path: Path) -> None:
    for name in ("older", "newer"):
        (tmp_path / name / LAST_CHECKPOINT).parent.mkdir(parents=True)
        (tmp_path / name / LAST_CHECKPOINT).touch()
    os.utime(tmp_path / "older" / LAST_CHECKPOINT, (1, 1))
    assert find_checkpoint("last", tmp_path / "new") == tmp_path / "newer" / LAST_CHECKPOINT
    assert find_checkpoint("last", tmp_path / "older") == tmp_path / "older" / LAST_CHECKPOINT
    assert find_checkpoint(None, tmp_path / "new") is None
    with pytest.raises(NerfroError, match=r"no checkpoint in .* or beside it; leave ckpt_path out"):
        find_checkpoint("last", tmp_path / "elsewhere" / "new")


def test_pickled_code_in_a_checkpoint_is_not_executed(tmp_path: Path) -> None:
    path, traces = tmp_path / "bomb.ckpt", tmp_path / "it_ran"
    torch.save({"nerfro_config": "seed: 0", "state_dict": Bomb(f"touch {traces}")}, path)
    message = refused("is not a readable nerfro checkpoint", load_checkpoint, path)
    assert "weights_only" not in message, "torch's advice would run it"
    assert not traces.exists()


def test_full_disk_is_refused_before_training(train: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage(100 * 2**20, 99 * 2**20, 2**20))
    assert "has 1 MiB free and this run needs " in train("trainer.max_steps=2", code=1).error
    assert not [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
