"""Arguments of Lightning's Trainer, callbacks and other settings take effect, or are refused or named with a reason."""

import importlib.util
import inspect
import json
import re
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any, get_args, get_type_hints

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Timer
from omegaconf import OmegaConf

import nerfro.training.trainer
from nerfro.core.progress import clock_time
from nerfro.registry.allowed import Refused, plain, untyped, validate
from nerfro.registry.registration import build, find, register
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.training.config import TrainConfig, TrainerConfig, resolve_trainer_options
from nerfro.training.effects import settings_without_effect
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from nerfro.training.settings import _NAMED, RESUMING, first_difference, settings
from nerfro.training.trainer import _OWN
from tests.conftest import Runner, composed, refused, weights_of

REFUSED = {
    name: reason
    for name, hint in get_type_hints(TrainerConfig, include_extras=True).items()
    for reason in get_args(hint)
    if isinstance(reason, Refused)
}
CALLBACK = '''
from lightning.pytorch import Callback
from nerfro.registry.registration import register

@register("callbacks", "broken")
class Broken(Callback):
    """Raise an error."""

    def on_train_batch_end(self, *_):
        raise RuntimeError("seventy-seven")
'''


def test_every_argument_of_lightnings_trainer_is_covered() -> None:
    arguments = set(inspect.signature(pl.Trainer.__init__).parameters) - {"self"}
    fields = set(TrainerConfig.__dataclass_fields__)
    assert arguments <= fields


@pytest.mark.parametrize("override", ["trainer.max_epochs=3", "+loss.nothing.weight=1"])
def test_cfg_refuses_the_settings_that_training_refuses_with_the_same_error(
    override: str, train: Runner, tmp_path: Path
) -> None:
    printed, trained = train(override, "--cfg", "job", code=1), train(override, code=1)
    assert printed.out == ""
    assert printed.error == trained.error
    assert not (tmp_path / "run").exists()


def test_settings_may_refer_to_hydra(train: Runner) -> None:
    printed = train("trainer.max_steps=1", "ckpt_path=${hydra:runtime.output_dir}/data", "--cfg", "job")
    assert "not checked: the pixels, the object and the memory, which train checks" in printed.err
    assert "ckpt_path: ${hydra:runtime.output_dir}/data" in printed.out


def test_cfg_refuses_missing_data_and_devices_after_the_configuration(
    train: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATA", str(tmp_path / "gone"))
    printed = train("trainer.max_steps=1", "data.root=${oc.env:DATA}", "--cfg", "job", code=1)
    assert "root: ${oc.env:DATA}" in printed.out
    assert (
        printed.error
        == f"nerfro: error: data.root={tmp_path / 'gone'} is not a folder; give the folder of the data set"
    )
    monkeypatch.setattr("nerfro.kernels.available.find_gpu", lambda: None)
    refused_gpu = train("trainer.max_steps=1", "trainer.accelerator=gpu", "--cfg", "job", code=1)
    assert refused_gpu.error.startswith("nerfro: error: trainer.accelerator=gpu needs a device")


@pytest.mark.parametrize("name", REFUSED)
def test_unsupported_arguments_are_refused_with_a_reason(name: str) -> None:
    config = OmegaConf.structured(untyped(TrainConfig()))
    config.trainer[name] = 3
    message = refused("is not allowed", validate, TrainConfig, plain(config), complete=False)
    assert message == f"trainer.{name}=3 is not allowed; {REFUSED[name]}"


@pytest.mark.parametrize(
    ("name", "value", "advice"),
    [
        ("deterministic", "foo", "choose True, False, 'warn'"),
        ("fast_dev_run", "abc", "take a number, not text"),
        ("fast_dev_run", -1, "take at least 0"),
        ("fast_dev_run", 1.5, "take an integer, at least 0"),
    ],
)
def test_settings_of_several_types_refuse_other_values(name: str, value: object, advice: str) -> None:
    message = refused("is not allowed", validate, TrainerConfig, {name: value}, "trainer.")
    assert message == f"trainer.{name}={value!r} is not allowed; {advice}"


@pytest.mark.parametrize(
    ("name", "value"),
    [("deterministic", "warn"), ("deterministic", False), ("fast_dev_run", True), ("fast_dev_run", 1)],
)
def test_settings_of_several_types_keep_each_of_their_values(name: str, value: object) -> None:
    setting = getattr(validate(TrainerConfig, {name: value}), name)
    assert (setting, type(setting)) == (value, type(value))


# A value that differs from the default for each argument that a run hands to Lightning's Trainer.
PASSED = {
    "accelerator": "cpu", "benchmark": True, "detect_anomaly": True, "deterministic": True, "devices": 1,
    "enable_checkpointing": False, "enable_model_summary": True, "enable_progress_bar": False,
    "gradient_clip_algorithm": "value", "gradient_clip_val": 0.5, "inference_mode": False, "log_every_n_steps": 7,
    "max_steps": 3, "max_time": "00:00:00:09", "min_steps": 2, "num_nodes": 1, "precision": "64-true",
    "strategy": "auto",
}  # fmt: skip


def test_other_arguments_reach_lightnings_trainer(train: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments: dict[str, Any] = {}

    def record(node: Any, **ours: Any) -> None:
        arguments.update({**node, **ours})
        sys.exit(3)

    monkeypatch.setattr(nerfro.training.trainer, "build", record)
    train("logger=none", *(f"trainer.{name}={value}" for name, value in PASSED.items()), code=3)
    assert PASSED.items() <= arguments.items()
    assert PASSED.keys() == TrainerConfig.__dataclass_fields__.keys() - {"_target_", *REFUSED, *_OWN}


@pytest.mark.parametrize(("option", "value", "steps"), [("debug", True, 10), ("trainer.fast_dev_run", 3, 3)])
def test_switches_shorten_runs_and_score_one_view(option: str, value: bool | int, steps: int) -> None:
    config = OmegaConf.structured(untyped(TrainConfig()))
    OmegaConf.update(config, option, value)
    config = resolve_trainer_options(config)
    assert config.trainer.max_steps == config.evaluation.every == steps
    assert config.trainer.limit_test_batches == 1


@pytest.mark.parametrize(
    ("duration", "length"),
    [
        ("90s", timedelta(seconds=90)),
        ("5m", timedelta(minutes=5)),
        ("1.5h", timedelta(hours=1.5)),
        ("2d", timedelta(days=2)),
        ("01:02:03:04", timedelta(days=1, hours=2, minutes=3, seconds=4)),
    ],
)
def test_durations_with_a_unit_equal_those_of_lightning(duration: str, length: timedelta) -> None:
    assert Timer(clock_time(duration)).time_remaining() == length.total_seconds()


def test_training_without_evaluation_ends_after_its_time(train: Runner, tmp_path: Path) -> None:
    finished = train("trainer.max_time=1s", "evaluation=none", "experiment=refractive", "name=mine")
    assert "page: python -m nerfro.view checkpoint=" in finished.out
    assert "max_time: 00:00:00:01\n" in (tmp_path / "run" / "config.yaml").read_text()
    assert not list(tmp_path.rglob("*.png"))
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_minimum_number_of_steps_exceeds_the_limit_of_time(train: Runner, tmp_path: Path) -> None:
    train("trainer.max_time=1s", "trainer.min_steps=3", "trainer.max_steps=3000", "evaluation=none")
    checkpoint, _ = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)
    assert 3 <= checkpoint["global_step"] < 3000


# Double precision compiles kernels of its own.
@pytest.mark.parametrize(
    "options", [pytest.param(["trainer.precision=64-true"], marks=pytest.mark.slow), ["batches.size=1"]]
)
def test_unusual_precision_and_size_train(options: list[str], train: Runner, tmp_path: Path) -> None:
    assert "4 steps in" in train(*options, "trainer.max_steps=4", "evaluation=none").out
    assert all(bool(values.isfinite().all()) for values in weights_of(tmp_path / "run").values())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["background.image=sky.exr", "model.colour=srgb"], "take model.colour=linear"),
        (
            [f"loss.{name}.weight=0" for name in ("photometric", "background", "smoothness", "total_variation")],
            "no loss has a positive weight in step 0",
        ),
    ],
)
def test_settings_without_an_effect_are_refused(options: list[str], message: str, train: Runner) -> None:
    assert message in train(*options, "trainer.max_steps=4", code=1).error


def test_all_of_space_needs_a_component_with_a_grid(train_here: Runner, tiny_scene: Path, tmp_path: Path) -> None:
    options = [f"data.root={tiny_scene}", "content.space=all", "field=nerf", "sampler/points=stratified"]
    ended = train_here(*options, "trainer.max_steps=1", f"hydra.run.dir={tmp_path / 'run'}", code=1)
    assert "add field=volume sampler/points=volume" in ended.error


def test_training_ends_with_the_table_of_means_and_the_files(train: Runner, tmp_path: Path) -> None:
    finished = train("trainer.max_steps=2")
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())
    table = finished.out.partition("2 steps in ")[2]
    full = next(line for line in table.splitlines() if line.strip().startswith("full"))
    assert f"{scores['test']['psnr']:.2f}" in full
    assert "test_000" not in table.partition("image: ")[0]
    picture, page, tables = (line.partition(": ")[2] for line in finished.out.splitlines()[-3:])
    assert Path(picture).is_file()
    assert page == f"python -m nerfro.view checkpoint={tmp_path / 'run'}"
    assert Path(tables.partition(",")[0]).is_file()


def test_overfitting_repeats_batches(train: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, draw, updated = [], PixelBatches.draw, []

    def recorded(self: PixelBatches, step: int) -> Any:
        drawn.append(step)
        return draw(self, step)

    monkeypatch.setattr(PixelBatches, "draw", recorded)
    monkeypatch.setattr(DensityGridSampler, "update", lambda self, fields, draws: updated.append(draws.step))
    finished = train("trainer.max_steps=6", "trainer.overfit_batches=2", "evaluation.every=0")
    assert set(drawn) <= {0, 1, 2}  # the thread that traces ahead draws one more
    assert updated == [1, 2, 3, 4, 5], "each update of the density grid draws other cells"
    assert re.search(r"100%.*step 6,.*train PSNR", finished.err), "a log ends with the last step"


def test_profiled_run_has_no_progress_bar_and_no_intermediate_checkpoints(train: Runner, tmp_path: Path) -> None:
    quiet = ["trainer.enable_progress_bar=false", "trainer.enable_checkpointing=false"]
    finished = train("trainer.max_steps=2", "trainer.profiler=simple", *quiet)
    assert "train PSNR" not in finished.err
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()  # written at the end
    (report,) = (tmp_path / "run" / "profile").glob("*.txt")
    assert "run_training_batch" in report.read_text()
    assert "run_training_batch" in finished.out


def test_early_stopping_prints_its_step_and_reason(train: Runner) -> None:
    stopping = "{monitor: val/psnr, mode: max, patience: 1, min_delta: 1000}"
    finished = train("trainer.max_steps=9", "evaluation.every=5", f"+callbacks.early_stopping={stopping}")
    assert "stopped by early stopping at step 2: Monitored metric val/psnr did not improve" in finished.out


@pytest.mark.usefixtures("restored_registry")
@pytest.mark.parametrize(
    ("error", "words"),
    [("RuntimeError", "raised in the plugin"), ("MemoryError", "sizes, such as those in the plugin")],
)
def test_errors_of_a_plugin_name_its_file_and_line(
    error: str, words: str, train: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "plugins" / "broken_callback.py"
    file.parent.mkdir()
    file.write_text(CALLBACK.replace("RuntimeError", error))
    monkeypatch.setenv("NERFRO_PLUGINS", str(file.parent))
    finished = train("trainer.max_steps=2", "+callbacks=broken", code=1)
    assert f"{words} {file}, line 10" in finished.err
    assert "bug of nerfro" not in finished.err


@pytest.mark.usefixtures("restored_registry")
def test_options_of_a_base_class_are_inherited() -> None:
    from nerfro.samplers.points.stratified import Stratified

    @register("sampler/points", "sparse")
    class Sparse(Stratified):
        """Half the samples."""

        def __init__(self, sparsity: int = 2, **options: Any) -> None:
            super().__init__(**options)
            self.num_samples //= sparsity

    plugin = find("sampler/points", "sparse")
    assert {"sparsity", "num_samples", "offset"} <= {name for name, _, _ in plugin.fields()}
    sampler = build({"_target_": plugin.target, "sparsity": 4, "num_samples": 32})
    assert sampler.num_samples == 8
    assert isinstance(sampler, torch.nn.Module)


@pytest.mark.parametrize(("name", "package"), [("mlflow", "mlflow"), ("comet", "comet")])
def test_loggers_of_lightning_are_options_and_name_a_missing_package(name: str, package: str, tmp_path: Path) -> None:
    config = composed(f"logger={name}")
    assert set(config.logger) == {"tensorboard", "csv", name}
    if importlib.util.find_spec(package) is None and importlib.util.find_spec(f"{package}_ml") is None:
        refused(f"needs another package .*{package}.*; install it with pip", build, config.logger[name], save_dir=".")


def test_every_setting_that_is_named_exists() -> None:
    config = composed()
    trainer = {f"trainer.{name}" for name in inspect.signature(pl.Trainer).parameters}
    media = {"medium.cache"}  # a field of some
    for name in set(_NAMED) - trainer - media:
        assert OmegaConf.select(config, name, default="absent") != "absent", name


def test_settings_are_flat_and_their_first_difference_is_named() -> None:
    flat = {"seed": 1, "field.width": 64, "field.levels": [1, 2], "checkpoints": "no group of watching"}
    watching = ("logger.csv.name=x", "checkpoint.every_steps=3", "evaluation.every=9", "trainer.profiler=simple")
    config = OmegaConf.from_dotlist([*(f"{name}={value}" for name, value in flat.items()), *watching])
    assert settings(config, RESUMING) == flat
    assert first_difference(flat, dict(flat)) is None
    assert first_difference(flat, {**flat, "seed": 2, "field.bias": True}) == "field.bias"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+experiment=straight", "medium.learn_ior=true"], "medium.learn_ior=True .* with sampler/path=straight"),
        (["+experiment=mipnerf", "medium.learn_absorption=true"], "change sampler/path"),
        (["sampler.path.least_weight=0.1"], "with sampler.path.branches=none; .* sampler.path.branches=first or all"),
        (["sampler/path=eikonal", "sampler.path.num_steps=64"], "sampler.path.integrator=euler"),
        (["phase.cameras.every=20"], "has no effect with camera=given; remove it, or choose camera=refined"),
        (["phase={cameras: {start: 5}}"], "phase.cameras.start=5 has no effect"),
        (["+experiment=straight", "phase.background.steps=20"], "content.space=all"),
        (
            ["background=skybox", "phase.background.steps=20"],
            "background=skybox; remove it, or choose background=envmap",
        ),
        (["phase.background.steps=0", "phase.background.start=50"], "phase.background.steps=0"),
        (["content.radius=2"], "content.space=box"),
        (["batches.precrop_fraction=0.3"], "batches.precrop_steps=0"),
        (["optimizer.warmup_steps=0", "optimizer.warmup_factor=0.5"], "optimizer.warmup_steps=0"),
        (["trainer.gradient_clip_algorithm=value"], "trainer.gradient_clip_val=null"),
    ],
)
def test_setting_without_effect_is_reported(overrides: list[str], message: str) -> None:
    [line] = settings_without_effect(composed(*overrides), overrides)
    assert re.search(message, line)


@pytest.mark.parametrize(
    "overrides",
    [
        ["+experiment=straight", "medium.learn_ior=false", "content.radius=2", "phase.background.steps=0"],
        ["+experiment=glass_room", "sampler.path.branches=none"],  # the experiment has a value, the user has none
        ["+experiment=unknown", "medium.learn_ior=true", "sampler.path.least_weight=0.1"],
        ["sampler/path=eikonal", "sampler.path.integrator=euler", "sampler.path.num_steps=64"],
        ["camera=refined", "phase.cameras.every=20", "phase.background={steps: 20, start: 100}"],
        ["optimizer.groups={background.*: {start: 0}}", "loss.background={weight: 0.1, start: 5}", "hydra.run.dir=out"],
        ["trainer.gradient_clip_algorithm=value", "trainer.gradient_clip_val=0.1", "~phase.cameras"],
        ["logger=wandb", "logger.wandb.offline=true"],
    ],
)
def test_setting_with_effect_or_in_its_default_state_is_accepted(overrides: list[str]) -> None:
    assert settings_without_effect(composed(*overrides), overrides) == []
