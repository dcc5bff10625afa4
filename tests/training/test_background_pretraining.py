"""The sky is learned before the first step, from rays that miss the object, and by nothing else."""

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

from nerfro.data.blender import BlenderData
from nerfro.evaluation.results import read_metrics_json
from nerfro.training.callbacks import steps_by_phase
from nerfro.training.phases import background
from nerfro.training.ray_batches import RayBatches
from nerfro.training.run_folder import LAST_CHECKPOINT, load_checkpoint

FOLDER = "hydra.run.dir"


@pytest.fixture
def weights(
    train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., dict[str, Tensor]]:
    """Weights after a run whose rates are too small to move anything after its first steps."""
    monkeypatch.setattr(background, "_SHARE", 1.0)
    still = ["trainer.max_steps=1", "evaluation.every=0", "optimizer.warmup_factor=0", "optimizer.warmup_steps=1000"]

    def run(name: str, *overrides: str) -> dict[str, Tensor]:
        finished = train_here(*tiny_default_run, *still, f"{FOLDER}={tmp_path / name}", *overrides)
        assert finished.code == 0, finished.out + finished.err
        return load_checkpoint(tmp_path / name / LAST_CHECKPOINT)[0]["state_dict"]

    return run


def test_the_boundary_alone_has_learned_before_the_first_step(weights: Callable[..., dict[str, Tensor]]) -> None:
    without, learned = weights("without", "phase.background.steps=0"), weights("with", "phase.background.steps=20")
    changed = {name for name, value in learned.items() if not torch.equal(value, without[name])}
    assert changed == {"renderer.scene.boundary.texels"}


def test_pretraining_leaves_time_for_the_scene(
    weights: Callable[..., dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seconds = itertools.count()
    monkeypatch.setattr(timer, "time", SimpleNamespace(monotonic=lambda: float(next(seconds))))
    weights("run", "phase.background.steps=100000", "trainer.max_time=300s")
    checkpoint = load_checkpoint(tmp_path / "run" / LAST_CHECKPOINT)[0]
    phases = steps_by_phase(checkpoint["callbacks"], checkpoint["global_step"])
    # The clock advances by at least a second in each step, and pretraining takes a fifth of the limit.
    assert phases["scene"] == 1
    assert 0 < phases["background"] <= 60
    assert read_metrics_json(tmp_path / "run" / "metrics.json").steps_by_phase == phases


def test_rays_that_miss_a_box_have_their_own_colours(tiny_scene: Path) -> None:
    views = BlenderData(str(tiny_scene), near=2.0, far=6.0).load("train")
    batches = RayBatches(views, 16, "all_images")
    box = torch.tensor([[-0.6] * 3, [0.6] * 3])
    rays, view, rgb = batches.missing(box, 500, 0)
    assert 100 < len(rays) < 500
    assert set(view.tolist()) == {0, 1, 2}
    # The scene's sky is a linear function of direction, seen wherever the ball is not.
    assert torch.allclose(rgb, 0.5 + 0.4 * rays.directions, atol=3e-3)
    nearest = rays.origins - (rays.origins * rays.directions).sum(-1, keepdim=True) * rays.directions
    assert (nearest.norm(dim=-1) > 0.6).all()
    again, others = (batches.missing(box, 500, step)[0] for step in (0, 1))
    assert torch.equal(again.directions, rays.directions)
    assert len(others) != len(rays) or not torch.equal(others.directions, rays.directions)


def test_a_signal_ends_these_steps_and_a_resumed_run_takes_the_others(
    weights: Callable[..., dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options, drawn, missing = ("phase.background.steps=20", "trainer.max_steps=2"), [], RayBatches.missing

    def signalled(self: RayBatches, *given: Any) -> Any:
        drawn.append(given[2])
        if drawn[-1] == 7:
            os.kill(os.getpid(), signal.SIGINT)
        return missing(self, *given)

    undisturbed = weights("undisturbed", *options)
    with monkeypatch.context() as context:
        context.setattr(RayBatches, "missing", signalled)
        with pytest.raises(AssertionError, match="interrupted after step 0 and saved"):
            weights("run", *options)
    assert drawn == list(range(8))
    resumed = weights("run", *options, "ckpt_path=last")
    assert all(torch.equal(value, undisturbed[name]) for name, value in resumed.items())
