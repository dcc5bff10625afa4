"""Modules of `nerfro.build` with any Trainer of Lightning: validation, checkpoints, tests, predictions and logs."""

import csv
import importlib.util
import signal
from collections.abc import Callable
from pathlib import Path

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.tuner import Tuner

import nerfro
from nerfro.core.paths import PLUGINS_DIR
from nerfro.core.types import Batch
from nerfro.optimizers.config import OPTIMIZERS, OptimizerConfig
from nerfro.training.callbacks import StopOnSignal
from nerfro.training.data_module import RayDataModule
from nerfro.training.module import TrainingModule
from nerfro.training.run_folder import load_checkpoint
from tests.conftest import refused

QUIET = {"accelerator": "cpu", "enable_progress_bar": False, "enable_model_summary": False}


@pytest.fixture
def built(unchecked: None, tiny_default_run: list[str]) -> tuple[TrainingModule, RayDataModule]:
    return nerfro.build(None, [*tiny_default_run, "trainer.max_steps=4", "evaluation.every=10"])


def test_any_trainer_validates_saves_tests_predicts_and_logs(
    built: tuple[TrainingModule, RayDataModule], tmp_path: Path, restored_registry: None
) -> None:
    module, data = built
    spec = importlib.util.spec_from_file_location("template", PLUGINS_DIR / "opt_in" / "example_callback.py")
    assert spec is not None
    assert spec.loader is not None
    template = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(template)
    best = ModelCheckpoint(tmp_path, monitor="val/psnr", mode="max", save_top_k=1)
    callbacks = [best, EarlyStopping("val/psnr", mode="max", patience=9), template.GradientNorm()]
    logger = CSVLogger(tmp_path, name="log", version="")
    trainer = lightning.Trainer(max_steps=7, log_every_n_steps=3, logger=logger, callbacks=callbacks, **QUIET)
    trainer.fit(module, datamodule=data)
    assert trainer.global_step == 7
    assert len(best.best_k_models) == 1, "validation every two steps"
    (scores,) = trainer.test(module, datamodule=data, verbose=False)
    predictions = torch.stack(trainer.predict(module, datamodule=data))
    photographs = torch.stack([data.test.images[view] for view in range(len(predictions))])
    errors = (predictions - photographs).square().flatten(1).mean(-1)
    assert scores["test/psnr"] == pytest.approx(float((-10 * errors.log10()).mean()), abs=1e-3)
    assert nerfro.load(best.best_model_path).cameras("test").height == 16
    with (tmp_path / "log" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows if row["train/gradient_norm"]] == [2, 5]
    assert [int(row["step"]) for row in rows if row["val/psnr"]] == [1, 3, 5]


def test_score_that_is_never_computed_and_data_that_are_missing_are_refused(
    built: tuple[TrainingModule, RayDataModule],
) -> None:
    module, data = built
    trainer = lightning.Trainer(max_steps=2, logger=False, callbacks=[EarlyStopping("val/psnr")], **QUIET)
    refused("needs pixels and views; add datamodule=data", trainer.fit, module, [0])
    other = lightning.Trainer(max_steps=2, logger=False, callbacks=[EarlyStopping("val/ssim")], **QUIET)
    refused("EarlyStopping monitors val/ssim, but validation logs only val/psnr", other.fit, module, datamodule=data)
    data.validation = None
    message = "EarlyStopping monitors val/psnr, but the run has no validation; give"
    refused(message, trainer.fit, module, datamodule=data)
    data._load_test = None
    refused("the data have no test views", trainer.test, module, datamodule=data, verbose=False)


ENDLESS = {"logger": False, "max_epochs": -1, "check_val_every_n_epoch": None, "limit_val_batches": 0, **QUIET}


class AtStep(Callback):
    """Act before the end of a training step."""

    def __init__(self, step: int, act: Callable[[], object]) -> None:
        self.step, self.act = step, act

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        if trainer.global_step == self.step:
            self.act()


def test_diverged_model_does_not_replace_the_checkpoint(
    built: tuple[TrainingModule, RayDataModule], tmp_path: Path
) -> None:
    module, data = built
    texels = module.scene.background.texels.data
    checkpoints = ModelCheckpoint(tmp_path, filename="last", every_n_train_steps=1, enable_version_counter=False)
    callbacks = [AtStep(3, lambda: texels.fill_(torch.nan)), checkpoints]
    trainer = lightning.Trainer(max_steps=9, callbacks=callbacks, **ENDLESS)
    message = r"the model diverged before step 3: renderer\.scene\.background\.texels has infinite numbers or NaN"
    refused(message, trainer.fit, module, datamodule=data)
    assert load_checkpoint(tmp_path / "last.ckpt")[0]["global_step"] == 2


def test_signal_ends_a_training_before_its_least_number_of_steps(built: tuple[TrainingModule, RayDataModule]) -> None:
    module, data = built
    callbacks = [AtStep(2, lambda: signal.raise_signal(signal.SIGTERM)), StopOnSignal()]
    limits = {"min_steps": 8, "max_steps": 9, "min_epochs": 0, "enable_checkpointing": False}
    trainer = lightning.Trainer(callbacks=callbacks, **limits, **ENDLESS)
    trainer.fit(module, datamodule=data)
    assert trainer.global_step == 2


def test_resumed_training_with_accumulated_gradients_has_new_batches(
    built: tuple[TrainingModule, RayDataModule], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (module, data), seen, step = built, list[int](), TrainingModule.training_step

    def record(module: TrainingModule, batch: Batch, index: int) -> dict[str, torch.Tensor]:
        seen.append(batch.draws.step)
        return step(module, batch, index)

    monkeypatch.setattr(TrainingModule, "training_step", record)
    options = {"accumulate_grad_batches": 2, "enable_checkpointing": False, **ENDLESS}
    trainer = lightning.Trainer(max_steps=2, **options)
    trainer.fit(module, datamodule=data)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    resumed = lightning.Trainer(max_steps=4, **options)
    resumed.fit(module, datamodule=data, ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    assert seen == [*range(8)]


def test_experiments_of_an_own_folder_are_built(tiny_default_run: list[str], tmp_path: Path, unchecked: None) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\noptimizer:\n  learning_rate: 0.0123\n")
    settings = [*tiny_default_run, "trainer.max_steps=4"]
    module, _ = nerfro.build("mine", settings, config_dir=tmp_path)
    assert module.optimizer_config.learning_rate == 0.0123
    refused("mine", nerfro.build, "mine", settings)


def test_learning_rate_finder_of_lightning_measures_a_curve_and_sets_the_rate(
    built: tuple[TrainingModule, RayDataModule], tmp_path: Path
) -> None:
    """Too small a rate does not lower the loss, too large a rate raises it, and the run begins with the suggestion."""
    module, data = built
    before = {name: value.clone() for name, value in module.state_dict().items()}
    trainer = lightning.Trainer(max_steps=3, logger=False, default_root_dir=tmp_path, **QUIET)
    finder = Tuner(trainer).lr_find(module, datamodule=data, min_lr=1e-6, max_lr=10, num_training=60)
    assert finder is not None
    rates = torch.tensor(finder.results["lr"])
    growth = rates.log().diff()[1:]  # Lightning skips a rate at the beginning
    assert torch.allclose(growth, growth[0], rtol=0.01)
    losses = torch.tensor(finder.results["loss"])
    assert float(losses[rates < 1e-5][-1]) > 1.1 * float(losses.min())
    assert float(losses[-1]) > 1.1 * float(losses.min())
    assert 1e-5 < module.learning_rate == finder.suggestion() < 1
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())
    trainer.fit(module, datamodule=data)
    common = next(group for group in trainer.optimizers[0].param_groups if group["name"] == "common")
    assert common["initial_lr"] == module.learning_rate
    assert 0 < common["lr"] < module.learning_rate


class Signs(torch.optim.Optimizer):
    """Step by the sign of the gradient, as the optimizer of a plugin."""

    def __init__(self, params, lr: float = 0.1, size: float = 1.0) -> None:
        super().__init__(params, {"lr": lr, "size": size})

    @torch.no_grad()
    def step(self, closure=None):
        with torch.enable_grad():
            loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter -= group["lr"] * group["size"] * parameter.grad.sign()
        return loss


def test_optimizers_and_schedulers_by_name_set_the_rates(
    unchecked: None, tiny_default_run: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(OPTIMIZERS, "signs", Signs)
    by_name = [
        *tiny_default_run, "trainer.max_steps=4", "~phase.background",
        "optimizer.name=signs", "optimizer.options.size=0.5", "optimizer.learning_rate=0.01",
        "optimizer.groups={background.*: {name: sgd, options: {momentum: 0.9}, start: 2}}",
        "optimizer.scheduler=ExponentialLR", "optimizer.scheduler_options={gamma: 0.5}",
    ]  # fmt: skip
    module, data = nerfro.build(None, by_name)
    before = {name: value.detach().clone() for name, value in module.renderer.parameters_by_name().items()}
    trainer = lightning.Trainer(max_steps=1, logger=False, enable_checkpointing=False, **QUIET)
    trainer.fit(module, datamodule=data)
    groups = {group["name"]: group for group in trainer.optimizers[0].param_groups}
    assert (groups["common"]["lr"], groups["common"]["size"]) == (0.005, 0.5)
    assert groups["background.*"]["momentum"] == 0.9
    for name, value in module.renderer.parameters_by_name().items():
        change = (value.detach() - before[name]).abs()
        step = 0.0 if name.startswith("background.") else 0.005
        assert torch.all((change - step).abs().lt(1e-6) | change.eq(0)), name


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optimizer.name=adem", "optimizer.name=adem is not allowed; did you mean adam"),
        ("optimizer.scheduler=StepLr", "optimizer.scheduler=StepLr is not allowed; did you mean StepLR"),
        ("optimizer.options={momentum: 0.9}", "optimizer adam has no option momentum; choose from betas"),
        ("optimizer.options={lr: 0.5}", "optimizer adam has no option lr; set learning_rate"),
        ("optimizer.options={betas: [2, 3]}", "optimizer adam: Invalid beta parameter"),
        ("optimizer.groups={background.*: {name: x}}", "groups: name=x is not allowed; known: adam"),
    ],
)
def test_wrong_optimizers_and_options_are_refused(
    override: str, message: str, unchecked: None, tiny_default_run: list[str]
) -> None:
    refused(
        message,
        lambda: nerfro.build(None, [*tiny_default_run, "trainer.max_steps=4", override])[0].configure_optimizers(),
    )


def test_missing_and_unknown_options_of_a_scheduler_are_refused() -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.ones(1))])
    for options, message in (({}, "missing .* 'T_max'"), ({"gamma": 1}, "has no option gamma; choose from T_max")):
        config = OptimizerConfig(scheduler="CosineAnnealingLR", scheduler_options=options)
        refused(f"optimizer.scheduler=CosineAnnealingLR.*{message}", config.scheduler_of, optimizer)


def test_optimizer_and_scheduler_of_a_derived_module_keep_their_rates(
    built: tuple[TrainingModule, RayDataModule], tmp_path: Path
) -> None:
    class Own(TrainingModule):
        def configure_optimizers(self):
            optimizer = torch.optim.Adamax(self.renderer.parameters(), lr=0.01)
            return [optimizer], [{"scheduler": torch.optim.lr_scheduler.StepLR(optimizer, 1, 0.5), "interval": "step"}]

    module, data = built
    own = Own(module.renderer, dict(module.objective.losses), module.optimizer_config)
    trainer = lightning.Trainer(max_steps=3, logger=False, enable_checkpointing=False, **QUIET)
    trainer.fit(own, datamodule=data)
    assert trainer.optimizers[0].param_groups[0]["lr"] == pytest.approx(0.01 / 8)
    own.configure_optimizers = lambda: torch.optim.Adamax(own.renderer.parameters(), lr=0.01)
    trainer = lightning.Trainer(max_steps=2, logger=False, enable_checkpointing=False, **QUIET)
    trainer.fit(own, datamodule=data)
    assert trainer.optimizers[0].param_groups[0]["lr"] == 0.01
