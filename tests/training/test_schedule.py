"""Phases take their steps, continue after an interruption, and fit the background around and through objects."""

import copy
import itertools
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Timer, timer
from torch import Tensor, nn
from torch.optim import Adam

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_srgb
from nerfro.core.types import Exits
from nerfro.data.base import Views
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.results import read_metrics_json
from nerfro.fields.base import Field
from nerfro.fields.hash_grid import HashGridField
from nerfro.rendering import RayTracer, Renderer
from nerfro.training.build import build
from nerfro.training.callbacks import Throughput, steps_by_phase
from nerfro.training.phases.background import BackgroundSettings, BackgroundSteps
from nerfro.training.phases.base import Phase, TrainingRun
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from nerfro.training.schedule import Schedule
from tests.conftest import Runner, refused, weights_of


class Counted(Phase):
    """Records its steps. It takes three before the first training step and one before every second one after it."""

    def __init__(self, record: list[tuple[str, int, int]], name: str, end: int) -> None:
        self.record, self.name, self.end = record, name, end

    def begin(self, run: TrainingRun) -> dict[str, Any]:
        self.record.append((self.name, -1, -1))
        return {"begun": len(self.record)}

    def steps_before(self, training_step: int) -> int:
        return 3 + training_step // 2

    def step(self, run: TrainingRun, number: int, state: dict[str, Any]) -> bool:
        self.record.append((self.name, number, state["begun"]))
        return number < self.end


def steps(schedule: Schedule, first: int, last: int, callbacks: Sequence[Callback] = ()) -> dict[str, Any]:
    """Take some training steps without a model; returns the state of the schedule."""
    module = Mock(spec=LightningModule, renderer=Mock(spec=Renderer))
    data = Mock(batches=Mock(spec=PixelBatches), tracer=Mock(spec=RayTracer))
    trainer = Mock(spec=Trainer, datamodule=data, lightning_module=module, optimizers=[Mock(spec=Adam)])
    trainer.configure_mock(global_step=first, max_steps=100, callbacks=list(callbacks))
    schedule.on_train_start(trainer, module)
    for trainer.global_step in range(first, last):
        schedule.on_train_batch_start(trainer, module, None, 0)
    return copy.deepcopy(schedule.state_dict())


def test_seconds_of_a_run_that_is_interrupted_in_a_phase_are_counted() -> None:
    throughput, trainer, module = Throughput(), Mock(spec=Trainer), Mock(spec=LightningModule)
    throughput.on_train_start(trainer, module)
    time.sleep(0.05)
    throughput.on_train_end(trainer, module)
    assert throughput.state_dict()["seconds"] >= 0.05


def test_step_without_a_result_is_refused() -> None:
    phase = Mock(spec=Phase, begin=lambda run: {}, steps_before=lambda step: 1, step=lambda run, number, state: None)
    refused(r"phase\.mine: step returned None; return True", steps, Schedule({"mine": phase}, Mock(spec=Views)), 0, 1)


def test_step_without_parameters_is_refused() -> None:
    renderer = Mock(spec=Renderer, parameters_by_name=lambda: {"background.colour": nn.Parameter(torch.zeros(()))})
    run = TrainingRun(renderer, Mock(spec=PixelBatches), Mock(spec=RayTracer), Mock(spec=Views), Mock(spec=Adam), 0.0)
    with pytest.raises(NerfroError, match=r"backgroud\.\* matches no learned .* choose from background\.colour"):
        run.parameters(["background.*", "backgroud.*"])
    refused("changes no parameter", run.descend, torch.zeros(()), run.parameters(["cameras.*"]))


@pytest.mark.parametrize("stop", [0, 2, 3])
def test_resumed_run_takes_the_phase_steps_of_an_uninterrupted_run(stop: int) -> None:
    def schedule(record: list[tuple[str, int, int]]) -> Schedule:
        return Schedule({name: Counted(record, name, end) for name, end in (("a", 9), ("b", 1))}, Mock(spec=Views))

    whole: list[tuple[str, int, int]] = []
    state = steps(schedule(whole), 0, 7)
    before = [("a", -1, -1), ("a", 0, 1), ("a", 1, 1), ("a", 2, 1), ("b", -1, -1), ("b", 0, 5), ("b", 1, 5)]
    assert whole == [*before, ("a", 3, 1), ("a", 4, 1), ("a", 5, 1)]
    assert steps_by_phase({"Schedule": state}, 7) == {"a": 6, "b": 1, "scene": 7}
    parted: list[tuple[str, int, int]] = []
    resumed = schedule(parted)
    resumed.load_state_dict(steps(schedule(parted), 0, stop))
    assert steps(resumed, stop, 7) == state
    assert parted == whole


def test_no_step_between_training_steps_begins_after_the_limit_of_time() -> None:
    record: list[tuple[str, int, int]] = []
    schedule = Schedule({"a": Counted(record, "a", 9)}, Mock(spec=Views))
    left = iter([2.0, 1.0, 0.0])
    timer = Mock(spec=Timer, time_elapsed=lambda: 10.0, time_remaining=lambda: next(left, 0.0))
    steps(schedule, 0, 0)
    state = steps(schedule, 9, 10, [timer])  # four steps are due
    assert [number for _, number, _ in record] == [-1, 0, 1, 2, 3]
    assert steps(schedule, 9, 10) != state
    assert [number for _, number, _ in record] == [-1, 0, 1, 2, 3, 4, 5, 6]


def test_step_of_a_phase_changes_only_its_parameters() -> None:
    moved, other = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
    optimizer = Adam([moved, other])
    (moved + other).sum().backward()
    optimizer.step()  # Lightning keeps the gradients until the next training step
    before = other.item()
    parts = (Mock(spec=part) for part in (Renderer, PixelBatches, RayTracer, Views))
    TrainingRun(*parts, optimizer, 0.0).descend(moved.square().sum(), [moved])
    assert other.item() == before
    assert moved.item() < before


@pytest.fixture
def weights(train: Runner, tmp_path: Path) -> Callable[..., dict[str, Tensor]]:
    """Weights after a run whose rates are too small to move anything after its first steps."""
    still = ["trainer.max_steps=1", "evaluation.every=0", "optimizer.warmup_factor=0", "optimizer.warmup_steps=1000"]

    def run(name: str, *overrides: str) -> dict[str, Tensor]:
        train(*still, f"hydra.run.dir={tmp_path / name}", *overrides)
        return weights_of(tmp_path / name)

    return run


@pytest.mark.slow
def test_only_the_background_is_fitted_before_the_first_step(weights: Callable[..., dict[str, Tensor]]) -> None:
    without, learned = weights("without", "phase.background.steps=0"), weights("with", "phase.background.steps=20")
    changed = {name for name, value in learned.items() if not torch.equal(value, without[name])}
    assert changed == {"renderer.scene.background.texels"}


@pytest.fixture
def begun(tiny_scene: Path, tiny_default_run: list[str]) -> Callable[..., TrainingRun]:
    """What phases get at the beginning of a run."""

    def begin(*options: str) -> TrainingRun:
        module, data = build(overrides=[*tiny_default_run, "trainer.max_steps=1", *options])
        views, optimizer = BlenderData(str(tiny_scene), 2.0, 6.0).load("train"), torch.optim.Adam(module.parameters())
        return TrainingRun(module.renderer, data.batches, RayTracer(module.renderer), views, optimizer, 0.0)

    return begin


def test_directions_behind_the_object_are_learned_through_it(
    begun: Callable[..., TrainingRun], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, phase = begun("medium.ior=1.0001"), BackgroundSteps(steps=4, start=8)
    state, centres = phase.begin(run), run.views.cameras.camera_to_world[:, :, 3]
    towards_the_ball = -torch.nn.functional.normalize(centres)
    sky, background = 0.5 + 0.4 * towards_the_ball, run.renderer.scene.background

    def error() -> float:
        return float((to_srgb(background(Exits(towards_the_ball))).detach() - sky).abs().max())

    assert error() > 0.1
    assert all(phase.step(run, number, state) for number in range(4, 8))  # the first pass through the object
    assert error() < 0.05
    monkeypatch.setattr(HashGridField, "bounds", Field.bounds)
    assert phase.begin(run) == {}
    assert "the field has no bounds" in capsys.readouterr().out
    background.requires_grad_(False)
    assert phase.begin(run) == {}, "a given background stays"


def test_rays_through_the_object_count_less_the_more_they_diverge(
    begun: Callable[..., TrainingRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, phase, fitted = begun("medium.ior=1.02"), BackgroundSteps(steps=1, start=8), []
    state, fit, sharp = phase.begin(run), EnvironmentMap.fit, 1 / run.batches.cameras.fx[0]
    monkeypatch.setattr(EnvironmentMap, "fit", lambda *given: fitted.append(given[1]) or fit(*given))
    assert all(phase.step(run, number, state) for number in range(2))
    beside, rays = fitted
    through = rays[torch.arange(len(rays.widths)) >= len(beside.widths)]
    assert (beside.weights == phase.settings.direct_weight).all()
    assert (through.widths > 1.1 * sharp).any()
    assert (through.weights <= (sharp / through.widths.clamp(min=float(sharp))).square() + 1e-6).all()
    assert through.weights.max() < 0.5 * beside.weights.min()


def test_fits_of_few_pixels_use_the_pixels_of_larger_fits(
    begun: Callable[..., TrainingRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    used, rows = [], PixelBatches.rows
    monkeypatch.setattr(PixelBatches, "rows", lambda *given: used.append(rows(*given)) or used[-1])
    of_limit = {}
    for limit in (10**6, 64):
        run, phase = begun(), BackgroundSteps(steps=2)
        state = phase.begin(run)
        phase.settings = BackgroundSettings(max_fitted_pixels=limit)
        assert all(phase.step(run, number, state) for number in range(2))
        sky = run.renderer.scene.background(Exits(run.views.cameras.image_rays(0).directions)).detach()
        of_limit[limit] = torch.cat(used).sort().values, state["weights"].sum(), to_srgb(sky)
        used.clear()
    (pixels, weight, sky), (pixels_of_all, weight_of_all, sky_of_all) = of_limit[64], of_limit[10**6]
    assert torch.equal(pixels, pixels_of_all)
    torch.testing.assert_close(weight, weight_of_all)
    assert (sky - sky_of_all).abs().mean() < 0.1 * (sky_of_all - sky_of_all.mean(0)).abs().mean()


def test_rays_that_split_into_colours_do_not_show_the_background(
    begun: Callable[..., TrainingRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, phase = begun("medium.bodies={object: {ior: 1.5, abbe: 30}}"), BackgroundSteps(steps=2, start=8)
    state = phase.begin(run)
    monkeypatch.setattr(run.renderer, "trace", lambda *given: pytest.fail("rays through the object are traced"))
    assert all(phase.step(run, number, state) for number in range(4))


def test_pretraining_takes_a_bounded_share_of_the_time(
    weights: Callable[..., dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seconds, fits, fit = itertools.count(), [], EnvironmentMap.fit
    monkeypatch.setattr(timer, "time", SimpleNamespace(monotonic=lambda: float(next(seconds))))
    monkeypatch.setattr(EnvironmentMap, "fit", lambda *given: fits.append(1) or fit(*given))
    weights("run", "phase.background.steps=100", "trainer.max_time=300s")
    checkpoint = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)[0]
    phases = steps_by_phase(checkpoint["callbacks"], checkpoint["global_step"])
    # The clock advances by at least a second in each step, and pretraining takes a fifth of the limit.
    assert phases == {"background": 100, "scene": 1}
    assert 0 < len(fits) <= 60
    assert read_metrics_json(tmp_path / "run" / "metrics.json").steps_by_phase == phases


def test_signal_interrupts_pretraining_and_a_resumed_run_completes_it(
    weights: Callable[..., dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options, drawn, rows = ("phase.background.steps=20", "trainer.max_steps=2"), [], PixelBatches.rows

    def signalled(self: PixelBatches, *given: Any) -> Any:
        drawn.append(given[0])
        if drawn[-1] == 7:
            os.kill(os.getpid(), signal.SIGINT)
        return rows(self, *given)

    undisturbed = weights("undisturbed", *options)
    with monkeypatch.context() as context:
        context.setattr(PixelBatches, "rows", signalled)
        with pytest.raises(AssertionError, match="interrupted after step 0 and saved"):
            weights("run", *options)
    assert drawn == list(range(8))
    resumed = weights("run", *options, "ckpt_path=last")
    assert all(torch.equal(value, undisturbed[name]) for name, value in resumed.items())
