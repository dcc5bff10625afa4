"""The background is fitted before the first step to rays that miss the object, and later to rays through it."""

import itertools
import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import timer
from torch import Tensor

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.light import to_srgb
from nerfro.core.types import Exits
from nerfro.data.formats.transforms import BlenderData
from nerfro.evaluation.results import read_metrics_json
from nerfro.fields.base import Field
from nerfro.fields.hash_grid import HashGridField
from nerfro.rendering import RayTracer
from nerfro.training.build import build
from nerfro.training.callbacks import steps_by_phase
from nerfro.training.phases.background import BackgroundSettings, BackgroundSteps
from nerfro.training.phases.base import TrainingRun
from nerfro.training.pixel_batches import PixelBatches
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint
from tests.conftest import Runner, weights_of


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
