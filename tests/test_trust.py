"""Commands execute nerfro, Hydra and registered plugins, but no code of files or the current directory."""

import pickle
from pathlib import Path

import pytest
from hydra.types import RunMode

from nerfro.cli.composition import Composer
from nerfro.core.errors import NerfroError
from nerfro.registry.registration import discover
from nerfro.training.config import TrainConfig
from tests.conftest import Bomb, Runner
from tests.processes import python

discover()

EVIL = "import pathlib\n\n\ndef run(*args, **options):\n    pathlib.Path(__file__).with_name('executed').touch()\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a module `evil` and a Hydra plugin, which leave a file where they are executed; none may be."""
    (tmp_path / "evil.py").write_text(EVIL)
    (tmp_path / "hydra_plugins").mkdir()
    (tmp_path / "hydra_plugins" / "evil.py").write_text(f"{EVIL}\n\nrun()\n")
    return tmp_path


def executed(folder: Path) -> list[Path]:
    return list(folder.rglob("executed"))


@pytest.mark.parametrize(
    "hydra",
    [
        "callbacks: {a: {_target_: evil.run}}",
        "callbacks: {a: {_target_: hydra.experimental.callbacks.LogJobReturnCallback, x: {_target_: evil.run}}}",
        "sweeper: {_target_: evil.run}",
        "launcher: {_target_: evil.run}",
        "launcher: {_target_: hydra_plugins.evil.run}",
        "callbacks: {a: {_target_: hydra.experimental.callbacks.evil.run}}",
        "callbacks: {a: {_target_: optuna.samplers.evil.run}}",
        "callbacks: {a: {_target_: optuna.samplers.TPESampler, custom_search_space: evil.run}}",
        "job_logging: {handlers: {console: {class: evil.run}}}",
        "hydra_logging: {formatters: {simple: {(): evil.run}}}",
        "job_logging: {handlers: {console: {class: logging.StreamHandler, stream: 'ext://evil.run'}}}",
        "callbacks: {a: '${loss.a}'}",
    ],
)
def test_configuration_files_name_no_foreign_code(hydra: str, folder: Path) -> None:
    write_experiment(folder, hydra)
    with (
        Composer("train", TrainConfig).hydra([str(folder / "conf")]) as composition,
        pytest.raises(NerfroError, match=r"^hydra\..*evil.run is not allowed"),
    ):
        composition.compose_config("train", ["+experiment=other"], RunMode.RUN)


def test_no_foreign_code_is_executed_before_it_is_refused(folder: Path) -> None:
    write_experiment(folder, "callbacks: {a: {_target_: evil.run}}")
    options = ("--config-dir", str(folder / "conf"), "-m", "seed=1,2", "+experiment=other", "trainer.max_steps=1")
    done = python("-m", "nerfro.train", *options, folder=folder)
    assert not executed(folder), done.stderr
    assert done.returncode == 1
    assert done.stderr.startswith("nerfro: error: hydra.callbacks.a._target_=evil.run is not allowed")
    assert len(done.stderr.splitlines()) == 1


def write_experiment(folder: Path, hydra: str) -> None:
    conf = folder / "conf" / "experiment"
    conf.mkdir(parents=True)
    loss = "loss: {a: {_target_: evil.run}}\n" if "loss" in hydra else ""
    (conf / "other.yaml").write_text(f"# @package _global_\nhydra: {{{hydra}}}\n{loss}")


def test_pickled_configuration_is_not_read(folder: Path, run_here: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    Path("config.pickle").write_bytes(pickle.dumps(Bomb("touch executed")))
    assert (
        "--experimental-rerun executes code" in run_here("train", "--experimental-rerun", "config.pickle", code=1).error
    )
    assert not executed(folder)
