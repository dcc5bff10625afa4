"""Sweeps that are stopped, continued and changed or fail in part, and their launchers and sweepers."""

import functools
import importlib
import itertools
import json
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hydra.core.plugins import Plugins
from omegaconf import OmegaConf

from nerfro.core.paths import CONF_DIR, scene_name
from nerfro.core.trust import GuardedConfigLoader
from nerfro.registry.allowed import plain, validate
from nerfro.training.config import TrainConfig
from nerfro.training.sweeps import _record, _require_same_cell, identity_of
from tests.conftest import Runner, composed, refused, write_tiny_scene
from tests.forked import Command
from tests.processes import ONE_THREAD, python

SWEEPS = sorted(path.stem for path in (CONF_DIR / "sweep").glob("*.yaml"))


@pytest.fixture
def sweep(train_here: Runner, tiny_run: list[str], tmp_path: Path) -> Runner:
    """`python -m nerfro.train -m` in this process, with tiny cells in tmp_path/sweep."""
    steps = ["trainer.max_steps=2", "evaluation.every=0", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    return functools.partial(train_here, "-m", *tiny_run, *steps)


@pytest.fixture
def start(tmp_path: Path, waiting_plugins: str, tiny_run: list[str]) -> Callable[[list[str], str], Command]:
    """Start a sweep with a loss that waits in a process, in tmp_path/sweep; what it prints goes to tmp_path/<name>."""
    options = [*tiny_run, "evaluation.every=0", "+loss.waiting.weight=1", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    options += ["trainer.max_steps=20", "checkpoint.every_steps=4", "checkpoint.every_seconds=null"]
    environment = {**ONE_THREAD, "TORCH_HOME": str(tmp_path), "NERFRO_PLUGINS": waiting_plugins}
    return lambda overrides, name: Command("train", ["-m", *options, *overrides], tmp_path / name, **environment)


def written(folder: Path) -> dict[str, int]:
    """When the scores of each cell were written."""
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/metrics.json")}


@pytest.mark.slow
def test_finished_cells_are_skipped_and_new_ones_added(sweep: Runner, tmp_path: Path) -> None:
    sweep("seed=0,1")
    before = written(tmp_path / "sweep")
    scene = scene_name(OmegaConf.load(next((tmp_path / "sweep").glob("*/config.yaml"))).data.root)
    assert set(before) == {f"refractive-{scene}-seed{seed}" for seed in (0, 1)}

    second = sweep("seed=1,2")
    assert f"refractive-{scene}-seed1 is finished" in second.out
    assert f"python -m nerfro.summary runs={tmp_path / 'sweep'}" in second.out
    after = written(tmp_path / "sweep")
    assert after.keys() - before.keys() == {f"refractive-{scene}-seed2"}
    assert {name: after[name] for name in before} == before


def test_configuration_is_composed_once_and_becomes_a_sweep_by_the_option_alone(
    train_here: Runner, tmp_path: Path
) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "own.yaml").write_text("# @package _global_\nhydra: {mode: MULTIRUN}\n")
    load = GuardedConfigLoader.load_configuration
    with patch.object(GuardedConfigLoader, "load_configuration", autospec=True, side_effect=load) as composition:
        finished = train_here("--config-dir", str(tmp_path), "experiment=own", code=1)
    assert finished.error.endswith("hydra.mode=MULTIRUN is not allowed here; start a sweep with the option -m")
    assert composition.call_count == 1


@pytest.mark.slow
def test_failing_cell_does_not_stop_other_cells(sweep: Runner, tiny_scene: Path, tmp_path: Path) -> None:
    late = tmp_path / "late.ply"
    swept = f"medium.mesh={late},{tiny_scene / 'mesh.ply'}"
    first = sweep(swept, code=1)
    assert f"late.ply: mesh {late} does not exist" in first.err
    assert str(late) in json.loads(next((tmp_path / "sweep").glob("*late.ply/cell.json")).read_text())["reason"]
    before = written(tmp_path / "sweep")
    assert len(before) == 1

    shutil.copy(tiny_scene / "mesh.ply", late)
    sweep(swept)
    assert len(written(tmp_path / "sweep")) == 2
    assert before.items() <= written(tmp_path / "sweep").items()


@pytest.mark.slow
def test_cell_of_another_configuration_or_other_data_is_never_replaced(
    sweep: Runner, tiny_scene: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    data = [f"data.root={scene}", "seed=0"]
    sweep(*data)
    before = written(tmp_path / "sweep")

    changed = sweep(*data, "trainer.max_steps=3", code=1)
    assert "holds a run with trainer.max_steps=2, not 3; choose another hydra.sweep.dir" in changed.err
    (scene / "test" / "r_9.png").write_bytes(b"more")
    assert "holds a run with other files in its data folder" in sweep(*data, code=1).err
    assert written(tmp_path / "sweep") == before


def test_missing_data_name_the_command_that_renders_them(sweep: Runner, tmp_path: Path) -> None:
    finished = sweep(f"data.root={tmp_path / 'ship'}", code=1)
    assert f"python -m nerfro.synthesize scene=ship out={tmp_path / 'ship'}" in finished.err


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_file_composes_its_cells(name: str) -> None:
    hydra: Any = OmegaConf.load(CONF_DIR / "sweep" / f"{name}.yaml").hydra
    assert hydra.sweep.dir == f"outputs/sweeps/{name}"
    axes = ([f"{key}={value}" for value in values.split(",")] for key, values in hydra.sweeper.params.items())
    for cell in itertools.zip_longest(*axes):  # every value is in one of these cells
        validate(TrainConfig, plain(composed(*filter(None, cell))))


SWEEPER = """
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

returned = []


class RecordingSweeper(BasicSweeper):
    def sweep(self, arguments):
        (batch,) = super().sweep(arguments)
        returned[:] = [job.return_value for job in batch]
"""


@pytest.mark.slow
def test_sweepers_of_other_packages_receive_the_metric_to_optimize(
    sweep: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site" / "hydra_plugins").mkdir(parents=True)
    (tmp_path / "site" / "hydra_plugins" / "recording.py").write_text(SWEEPER)
    monkeypatch.syspath_prepend(tmp_path / "site")
    recording = importlib.import_module("hydra_plugins.recording")
    Plugins.instance().register(recording.RecordingSweeper)
    chosen = ["hydra.sweeper._target_=hydra_plugins.recording.RecordingSweeper", "medium.ior=1.4,1.6"]
    sweep(*chosen, "optimized_metric=ssim")
    before, scores = written(tmp_path / "sweep"), list(recording.returned)
    files = sorted((tmp_path / "sweep").glob("*/metrics.json"))
    assert [file.parent.name.rpartition("-")[2] for file in files] == ["ior=1.4", "ior=1.6"]
    assert scores == [json.loads(file.read_text())["test"]["ssim"] for file in files]
    sweep(*chosen, "optimized_metric=ssim")
    assert (recording.returned, written(tmp_path / "sweep")) == (scores, before), "finished cells are not trained"
    unknown = sweep("seed=1", "optimized_metric=beauty", code=1)
    assert "no metric is called 'beauty'; known: flip, lpips" in unknown.err


def test_optuna_searches_and_repeats_its_search(sweep: Runner, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs pip install 'nerfro[optuna]'")
    search = [
        "hydra/sweeper=optuna",
        "hydra.sweeper.n_trials=2",
        "hydra.sweeper.n_jobs=1",
        "medium.ior=interval(1.3,1.6)",
    ]
    options = ["hydra.sweeper.direction=maximize", "hydra.sweeper.sampler.seed=0"]
    sweep(*search, *options)
    scores = [json.loads(file.read_text())["test"]["psnr"] for file in (tmp_path / "sweep").glob("*/metrics.json")]
    best = OmegaConf.load(tmp_path / "sweep" / "optimization_results.yaml").best_value
    assert (len(scores), best) == (2, max(scores))
    before = written(tmp_path / "sweep")
    sweep(*search, *options)
    assert written(tmp_path / "sweep") == before


def test_identity_of_a_cell_ignores_settings_of_monitoring() -> None:
    plain = identity_of(composed())
    watched = ("logger=none", "checkpoint.every_seconds=5", "ckpt_path=last", "evaluation.every=7", "trainer.devices=2")
    assert identity_of(composed(*watched)) == plain
    for override in ("seed=1", "trainer.max_steps=7", "medium.ior=1.4", "evaluation.split=val"):
        assert identity_of(composed(override)) != plain


@pytest.mark.parametrize("name", ["cameras.bin", "transforms.json"])
def test_recalibrated_data_are_different_data(name: str, tmp_path: Path) -> None:
    def identity() -> str:
        return identity_of(composed(f"data.root={tmp_path}"))["data"]

    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / name).write_bytes(b"before")
    (tmp_path / "r_0.PNG").write_bytes(b"before")
    before = identity()
    (tmp_path / "r_0.PNG").write_bytes(b"after!")
    assert identity() == before, "pictures are known by name and size"
    (tmp_path / "sparse" / name).write_bytes(b"after!")
    assert identity() != before


def test_cell_with_moved_data_is_the_same_cell(tmp_path: Path) -> None:
    identities = []
    for name, radius in (("data", 1.0), ("moved", 1.0), ("other", 1.1)):
        write_tiny_scene(tmp_path / name, radius)
        config = composed(f"data.root={tmp_path / name}", "medium.mesh=${data.root}/mesh.ply")
        identities.append(identity_of(config))
    _record(tmp_path, identities[0])
    _require_same_cell(tmp_path, identities[1])
    refused("with another content of the file medium.mesh", _require_same_cell, tmp_path, identities[2])


def test_results_of_a_sweep_inside_the_data_folder_are_no_data(tmp_path: Path) -> None:
    config = composed(f"data.root={tmp_path}")
    (tmp_path / "transforms.json").write_bytes(b"data")
    (tmp_path / "sweep").mkdir()
    before = identity_of(config, tmp_path / "sweep")
    assert before == identity_of(config, tmp_path) == identity_of(config, tmp_path.parent / "sweep")
    (tmp_path / "sweep" / "multirun.yaml").write_bytes(b"result")
    assert identity_of(config, tmp_path / "sweep") == before
    assert identity_of(config, tmp_path.parent / "sweep") != before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_stopped_sweep_is_resumed(
    number: signal.Signals, start: Callable[[list[str], str], Command], tiny_scene: Path, tmp_path: Path
) -> None:
    first = start(["seed=0,1,2"], "first")
    cells = [tmp_path / "sweep" / f"refractive-{scene_name(str(tiny_scene))}-seed{seed}" for seed in range(3)]
    deadline = time.monotonic() + 300
    while not ((cells[0] / "metrics.json").is_file() and (cells[1] / "checkpoints" / "last.ckpt").is_file()):
        assert first.runs, first.errors
        assert time.monotonic() < deadline
        time.sleep(0.05)
    first.send(number)
    assert first.wait(60) == (-signal.SIGKILL if number is signal.SIGKILL else 130)
    if number is signal.SIGINT:
        assert "to resume, repeat the command" in first.printed + first.errors
    assert not (cells[1] / "metrics.json").exists()
    assert not cells[2].exists()
    before = written(tmp_path / "sweep")

    log = start(["seed=0,1,2"], "second").finished()
    assert before.items() <= written(tmp_path / "sweep").items(), "the finished cell was left alone"
    steps = [int(line.rpartition("at step ")[2]) for line in log.splitlines() if "at step " in line]
    assert steps[0] >= 4, "the second cell went on from its checkpoint"
    assert steps == [*range(steps[0], 20), *range(20)], "and the third began at the beginning"


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_launchers_run_cells_in_other_processes(
    launcher: str, sweep: Runner, tiny_run: list[str], tmp_path: Path
) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.split('_')[0]}_launcher")
    overrides = [f"medium.mesh={tmp_path / 'nowhere.ply'},{'${data.root}/mesh.ply'}", "trainer.max_steps=2"]
    overrides.append(f"hydra/launcher={launcher}")
    overrides += ["evaluation.every=0", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    environment = {**ONE_THREAD, "TORCH_HOME": str(tmp_path)}
    done = python("-m", "nerfro.train", "-m", *tiny_run, *overrides, folder=tmp_path, **environment)
    log = done.stdout + done.stderr
    assert done.returncode == 1, log
    assert f"{tmp_path / 'nowhere.ply'} does not exist" in log
    (run,) = (tmp_path / "sweep").glob("*/run.json")
    assert json.loads(run.read_text())["command"].startswith("python -m nerfro.train data.root=")


@pytest.mark.slow
def test_damaged_record_repeats_only_its_own_cell(sweep: Runner, tmp_path: Path) -> None:
    sweep("seed=0,1")
    record = sorted((tmp_path / "sweep").glob("*/cell.json"))[0]
    record.write_text(record.read_text()[:40])
    finished = sweep("seed=0,1", code=1)
    assert f"{record} is damaged" in finished.err
    assert "is finished" in finished.out, "the other cell"


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("+batches.foo=1", "batches.foo is not a setting"),
        ("batches.precrop_fraction=nan", "fraction=nan is not allowed"),
        ("hydra.sweep.dir=/", "hydra.sweep.dir=/ is a whole file system; give a folder below it"),
    ],
)
def test_settings_of_cells_are_checked(override: str, words: str, sweep: Runner, tmp_path: Path) -> None:
    assert words in sweep("seed=0,1", override, code=1).err
    assert not list((tmp_path / "sweep").rglob("*.ckpt"))
