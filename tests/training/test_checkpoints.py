"""Best checkpoints, averages of weights, and initial values from another run, from the command line."""

import shutil
from pathlib import Path

import pytest
import torch

import nerfro
from tests.conftest import Runner, weights_of

SHORT = ["evaluation.every=10", "evaluation=none", "trainer.max_steps=6"]


@pytest.mark.slow
def test_best_checkpoints_and_averages_are_evaluated_and_loaded(
    train: Runner, tmp_path: Path, evaluate_here: Runner
) -> None:
    best = ["callbacks.model_checkpoint.monitor=val/psnr", "callbacks.model_checkpoint.save_top_k=2"]
    train(*SHORT, "callbacks=[model_checkpoint,weight_averaging]", *best, "callbacks.weight_averaging.decay=0.5")
    files = sorted((tmp_path / "run" / "checkpoints").glob("step*.ckpt"))
    assert len(files) == 2, "two of three validations"
    content = torch.load(files[-1], weights_only=True)  # at the end, both are the average
    average, latest = content["state_dict"], content["current_model_state"]
    weights = [name for name in average if "renderer.scene.fields" in name and average[name].is_floating_point()]
    assert any(not torch.equal(average[name], latest[name]) for name in weights)
    scene = nerfro.load(files[0], device="cpu")
    assert scene.render(scene.cameras("test").select([0])).rgb.shape == (1, 16, 16, 3)
    assert "average of weights" in repr(scene)
    scored = evaluate_here(f"checkpoint={files[0]}", f"out={tmp_path / 'scores'}")
    assert "weights: moving average" in scored.out
    assert (tmp_path / "scores" / "metrics.json").is_file()


def test_matching_parameters_of_another_run_are_initial_values(
    train: Runner, trained_run: Path, tmp_path: Path
) -> None:
    other = [f"init_from={trained_run}", "field.width=8", "optimizer.freeze=[background.*]"]
    finished = train(*SHORT, "trainer.max_steps=1", *other)
    assert "loaded background.texels: shape [" in finished.out
    assert "skipped fields.0." in finished.out
    assert "shape [" in finished.out
    name = "renderer.scene.background.texels"
    assert torch.equal(weights_of(tmp_path / "run")[name], weights_of(trained_run)[name]), "frozen"
    patterns = "init_include=[backgroud.*]"
    error = train(*SHORT, *other, patterns, "hydra.run.dir=" + str(tmp_path / "again"), code=1).error
    assert "init_include: backgroud.* matches no learned parameter" in error


def test_run_is_resumed_without_the_run_of_its_initial_values(train: Runner, trained_run: Path, tmp_path: Path) -> None:
    shutil.copytree(trained_run, tmp_path / "other")
    options = [*SHORT, f"init_from={tmp_path / 'other'}", "init_include=[background.*]"]
    train(*options, "trainer.max_steps=1")
    shutil.rmtree(tmp_path / "other")
    resumed = train(*options, "trainer.max_steps=2", "ckpt_path=last")
    assert "2 steps in" in resumed.out
    assert "loaded" not in resumed.out
