"""A medium that learns must learn, whatever the model and the path sampler are made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfro.training.run_folder import load_checkpoint


@pytest.mark.parametrize("integrator", ["leapfrog", "adaptive"], ids=lambda name: f"eikonal, {name}")
def test_a_medium_with_parameters_learns_in_the_refractive_model(
    train_here: Callable[..., Any], tiny_run: list[str], tmp_path: Path, integrator: str
) -> None:
    skipped = ("medium", "sampler.path", "trainer.max_steps")
    options = [option for option in tiny_run if not option.startswith(skipped)]
    options += [
        "medium=index_field",
        "medium.mesh=${data.root}/mesh.ply",
        "medium.width=8",
        "medium.depth=2",
        "medium.skip=0",
    ]
    options += [
        f"sampler.path.integrator={integrator}",
        "loss.boundary.weight=0",
        "optimizer.medium_learning_rate=0.01",
    ]
    if integrator == "leapfrog":
        options.append("sampler.path.num_steps=32")
    weights = []
    for steps in (1, 4):
        folder = tmp_path / f"run{steps}"
        done = train_here(*options, f"trainer.max_steps={steps}", f"hydra.run.dir={folder}", "logger=none")
        assert done.code == 0, done.err
        state = load_checkpoint(folder / "checkpoints" / "last.ckpt")[0]["state_dict"]
        weights.append(torch.cat([value.flatten() for name, value in state.items() if name.startswith("medium.")]))
    assert (weights[0] - weights[1]).abs().max() > 1e-4
