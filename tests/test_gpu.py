"""A GPU computes what the CPU computes. Machines without a GPU skip these tests; `test_devices.py` runs everywhere."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from nerfro.evaluation.render_view import render_view
from nerfro.registry.registration import build
from nerfro.rendering import RayTracer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.config import build_medium, build_model
from nerfro.training.derivation import derived
from nerfro.training.module import TrainingModule
from nerfro.training.pixel_batches import PixelBatches
from tests.conftest import composed
from tests.test_experiments import EXPERIMENTS, SMALL, shrunk

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

# A step at which all losses have begun.
STEP = 100_000
SINGLE = ["field.precision=float32"]


def step_on(device: str, overrides: list[str]) -> tuple[float, Tensor, Tensor]:
    """Return the loss of a training step, its gradient, and a rendered view."""
    config = composed(*overrides)
    torch.manual_seed(0)
    views = build(config.data).load("train")
    config = derived(config, build_medium(config), views)
    renderer = build_model(config)
    renderer.scene.begin(views.cameras)
    module = TrainingModule.of(renderer, config).to(device)
    module.log = lambda *values, **options: None  # type: ignore[method-assign]
    pixels = PixelBatches(views, 256, config.batches.batching).to(device).draw(STEP)
    batch = RayTracer(renderer, Subdivision(**config.batches.subdivision)).trace(pixels)
    loss = module.training_step(batch, 0)["loss"]
    loss.backward()
    gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in module.parameters()]
    rendered = render_view(renderer, views.cameras.to(device), 0, Subdivision()).radiance
    return loss.item(), parameters_to_vector(gradients).cpu(), rendered.cpu()


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if "ablation_" not in name])
def test_training_step_and_view_match_the_cpu(
    experiment: str, unchecked: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TrainingModule, "global_step", STEP)
    overrides = [f"+experiment={experiment}", *SMALL, "data.downscale=4"]
    config = composed(*overrides)
    overrides += shrunk(config)
    overrides += SINGLE if "precision" in config.field else []
    overrides.append("trainer.precision=32-true")
    (loss, gradient, view), (expected_loss, expected_gradient, expected_view) = (
        step_on(device, overrides) for device in ("cuda", "cpu")
    )
    assert loss == pytest.approx(expected_loss, rel=1e-3)
    assert torch.cosine_similarity(gradient, expected_gradient, dim=0) > 0.99
    # Rays at grazing incidence may take another way.
    assert (view - expected_view).abs().amax(-1).quantile(0.98) < 2e-3


def test_run_on_the_gpu_is_resumed_evaluated_rendered_and_exported(
    train_here: Callable[..., Any], run_here: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    small = [*SMALL, "data.downscale=2", "trainer.accelerator=gpu", "batches.size=512", f"hydra.run.dir={run}"]
    train_here(*small, "trainer.max_steps=30")
    train_here(*small, "trainer.max_steps=60", "ckpt_path=last")
    trained = json.loads((run / "metrics.json").read_text())
    assert trained["steps"] == 60
    scores = {}
    for device in ("cuda", "cpu"):
        out = tmp_path / device
        run_here("evaluate", f"checkpoint={run}", f"device={device}", f"out={out}", "split=val")
        scores[device] = json.loads((out / "metrics.json").read_text())["test"]["psnr"]
        run_here("render", f"checkpoint={run}", f"device={device}", "views=val", f"out={out / 'rendered'}")
    assert scores["cuda"] == pytest.approx(scores["cpu"], abs=0.05)
    run_here("export", f"checkpoint={run}", "what=page", f"out={tmp_path / 'page.html'}", "device=cuda")
    assert (tmp_path / "page.html").stat().st_size > 100_000


def test_networks_are_compiled_on_the_gpu(train_here: Callable[..., Any], tmp_path: Path) -> None:
    options = [*SMALL, "trainer.accelerator=gpu", "compile=inductor", f"hydra.run.dir={tmp_path}"]
    train_here("+experiment=mipnerf", *shrunk(composed("+experiment=mipnerf")), *options)
    assert np.isfinite(json.loads((tmp_path / "metrics.json").read_text())["test"]["psnr"])
