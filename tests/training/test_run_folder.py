"""A folder belongs to one run: files of other runs, users and processes are kept."""

import functools
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from nerfro.cli.entry import entry_point
from nerfro.files.atomic import hold
from nerfro.training.config import TrainConfig
from nerfro.training.data_module import RayDataModule
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from tests.conftest import Runner, refused, weights_of


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def train(train: Runner) -> Runner:
    """Two steps in tmp_path/run."""
    return functools.partial(train, "trainer.max_steps=2", "evaluation.every=0")


@pytest.fixture
def begun(trained_run: Path, tmp_path: Path) -> Path:
    """A finished run in tmp_path/run."""
    return shutil.copytree(trained_run, tmp_path / "run")


@pytest.fixture
def evaluate(begun: Path, evaluate_here: Runner) -> Runner:
    """Evaluate the run in tmp_path/run."""
    return functools.partial(evaluate_here, f"checkpoint={begun / LAST_CHECKPOINT}")


@pytest.mark.parametrize(
    ("going_on", "file"), [("null", "config.yaml"), ("last", "notes/mine.txt"), ("elsewhere", "config.yaml")]
)
def test_files_of_others_in_the_run_folder_are_kept(
    going_on: str, file: str, train: Runner, trained_run: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    (folder / file).parent.mkdir(parents=True)
    (folder / file).write_text("foreign")
    before = sorted(folder.rglob("*"))
    checkpoint = trained_run / LAST_CHECKPOINT if going_on == "elsewhere" else going_on
    assert train(f"ckpt_path={checkpoint}", code=1).error
    assert sorted(folder.rglob("*")) == before
    assert (folder / file).read_text() == "foreign"


@pytest.mark.slow
def test_run_without_checkpoints_is_not_replaced_and_begins_again_on_request(train: Runner, begun: Path) -> None:
    weights = weights_of(begun)
    shutil.rmtree(begun / "checkpoints")
    before = content(begun)
    refused = train("seed=9", code=1).error
    assert "already holds config.yaml" in refused
    assert "resume a run (ckpt_path=last) or choose another folder (hydra.run.dir=...)" in refused
    assert content(begun) == before
    for change, trained in (("seed=1", "seed=0, this run has 1"), ("medium.ior=1.3", "medium.ior=")):
        assert f"was trained with {trained}" in train("ckpt_path=last", change, code=1).error
    train("ckpt_path=last")
    again = weights_of(begun)
    assert all(weights[name].equal(again[name]) for name in weights)


def test_checkpoint_in_a_removed_folder_is_not_recreated(
    train: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = RayDataModule.train_dataloader

    def remove(module: Any) -> Any:
        shutil.rmtree(tmp_path / "run")
        return fit(module)

    monkeypatch.setattr(RayDataModule, "train_dataloader", remove)
    assert "was removed or replaced while nerfro was writing to the folder" in train(code=1).err
    assert not (tmp_path / "run").exists()


def test_evaluation_replaces_only_files_of_an_evaluation(evaluate: Runner, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    (mine / "images").mkdir(parents=True)
    (mine / "images" / "test_000.png").write_text("mine")
    for folder in (mine, tmp_path / "run"):
        before = content(folder)
        refused = evaluate(f"out={folder}", "overwrite=true", code=1).error
        assert "it is not the folder of an evaluation; give another out=" in refused
        assert content(folder) == before
    scores = tmp_path / "scores"
    evaluate(f"out={scores}")
    assert "metrics.json exists" in evaluate(f"out={scores}", code=1).error
    (scores / "metrics.json").unlink()  # as after a kill: the evaluation goes on
    evaluate(f"out={scores}")
    evaluate(f"out={scores}", "overwrite=true")


def test_refused_evaluation_leaves_no_folder(evaluate: Runner, tmp_path: Path) -> None:
    evaluate(f"out={tmp_path / 'a' / 'b'}", "split=night", code=1)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("below", ["", "run"])
def test_file_in_place_of_the_run_folder_is_refused(below: str, train: Runner, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    refused = train(f"hydra.run.dir={tmp_path / 'file' / below}", code=1).error
    assert "choose another hydra.run.dir" in refused
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.slow
def test_temporary_files_of_killed_processes_are_removed_and_others_kept(train: Runner, begun: Path) -> None:
    killed, written = (begun / "images" / f".{name}.png.{'a1' * 8}.partial" for name in ("killed", "written"))
    foreign = begun / "images" / ".foreign.partial"
    for path in (killed, written, foreign):
        path.write_text("half")
    with written.open("r+b") as file:
        assert hold(file)
        train("ckpt_path=last")
    assert [path.exists() for path in (killed, written, foreign)] == [False, True, True]


def test_unexpected_error_gives_one_line_and_a_traceback_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(config: object) -> None:
        raise ZeroDivisionError("a bug\nof two lines")

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["nerfro.train", f"hydra.run.dir={tmp_path / 'run'}"])
    main = entry_point("train", TrainConfig)(broken)
    with pytest.raises(SystemExit):
        main()
    (line,) = capsys.readouterr().err.strip().splitlines()
    (file,) = tmp_path.glob("nerfro_*.txt")
    assert "ZeroDivisionError: a bug; this is a bug of nerfro: please report it with" in line
    assert str(file) in line
    assert "raise ZeroDivisionError" in file.read_text()
    monkeypatch.setenv("NERFRO_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        main()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "not enough memory; take smaller sizes"),
        (RuntimeError("can't allocate memory: you tried to allocate 80 bytes"), "not enough memory (can't allocate"),
        (OSError(28, "No space left on device", "a.png"), "no space is left for a.png; free some"),
    ],
)
def test_lack_of_resources_is_not_reported_as_a_bug(
    error: Exception, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(config: object) -> None:
        raise error

    monkeypatch.setattr("sys.argv", ["nerfro.train", f"hydra.run.dir={tmp_path / 'run'}"])
    with pytest.raises(SystemExit):
        entry_point("train", TrainConfig)(broken)()
    assert words in capsys.readouterr().err


def set_weight(content: dict[str, Any], value: object) -> None:
    name = next(name for name, weight in content["state_dict"].items() if weight.is_floating_point() and weight.numel())
    content["state_dict"][name] = (
        value if isinstance(value, str) else torch.full_like(content["state_dict"][name], value)
    )


def set_config(content: dict[str, Any], key: str, value: object) -> None:
    config = OmegaConf.create(content["nerfro_config"])
    OmegaConf.update(config, key, value)
    content["nerfro_config"] = OmegaConf.to_yaml(config)


DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "weights are NaN": (lambda content: set_weight(content, math.nan), "infinite numbers or NaN in"),
    "weights are infinite": (lambda content: set_weight(content, math.inf), "infinite numbers or NaN in"),
    "weights are text": (lambda content: set_weight(content, "seven"), "holds a str as"),
    "weights are a list": (lambda content: content.update(state_dict=[1]), "holds a list as state_dict"),
    "callbacks are missing": (lambda content: content.pop("callbacks"), "lacks callbacks"),
    "callbacks are a list": (lambda content: content.update(callbacks=[1]), "holds a list as callbacks"),
    "loops are a number": (lambda content: content.update(loops=3), "holds a int as loops"),
    "a chunk of none": (lambda content: set_config(content, "evaluation.chunk_size", 0), "chunk_size=0 is not allowed"),
    "a chunk of text": (lambda content: set_config(content, "evaluation.chunk_size", "many"), "'many'"),
    "a box of two": (lambda content: set_config(content, "content.box_min", [0, 0]), "is not a box"),
    "a box of NaN": (lambda content: set_config(content, "content.box_min", [math.nan] * 3), "box_min"),
    "a box of text": (lambda content: set_config(content, "content.box_max", "large"), "box_max"),
    "an unknown setting": (lambda content: set_config(content, "evaluation.chunks", 1), "chunks"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_checkpoints_are_refused_in_one_line(damage: str, trained_run: Path, tmp_path: Path) -> None:
    content = torch.load(trained_run / LAST_CHECKPOINT, weights_only=True)
    change, message = DAMAGE[damage]
    change(content)
    torch.save(content, tmp_path / "damaged.ckpt")
    assert message in refused(r"damaged\.ckpt", load_checkpoint, tmp_path / "damaged.ckpt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(optimizer_states=[]), "does not fit its weights"),
        (lambda content: content["optimizer_states"][0]["state"][0].update(exp_avg=torch.zeros(7)), "does not fit"),
        (lambda content: content["optimizer_states"][0]["state"][0].pop("exp_avg_sq"), "does not fit"),
        (lambda content: content["optimizer_states"][0]["state"][0].update(other=torch.zeros(7)), "does not fit"),
        (lambda content: content["optimizer_states"][0]["state"][0]["exp_avg"].fill_(math.nan), "does not fit"),
        (lambda content: content["optimizer_states"][0]["param_groups"][0].update(betas=3), "does not fit"),
        (lambda content: content.update(loops={"fit_loop": 3}), "cannot be resumed"),
        (lambda content: content["callbacks"].update(Throughput=4), "cannot be resumed"),
    ],
)
def test_checkpoints_that_cannot_be_resumed_are_refused_in_one_line(
    change: Callable[[dict[str, Any]], object], message: str, train: Runner, begun: Path
) -> None:
    path = begun / LAST_CHECKPOINT
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)
    assert message in train("ckpt_path=last", "trainer.max_steps=4", code=1).error
