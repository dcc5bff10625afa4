"""Absorption that a training learns from photographs, against the true one."""

from pathlib import Path

import pytest
import torch

from nerfro.samplers.paths.snell import Snell
from nerfro.training.run_folder import load
from tests.ball_photographs import TRAINING, photographs_of, save, solid
from tests.conftest import Runner

AMBER, CLEAR = (0.1, 0.3, 0.7), (0.0, 0.0, 0.0)  # red, green and blue


@pytest.mark.slow
@pytest.mark.parametrize("absorption", [AMBER, CLEAR])
def test_absorption_is_learned_within_ten_percent(
    absorption: tuple[float, ...], train_here: Runner, tmp_path: Path
) -> None:
    """Dark fog within the ball would explain the part that is common to all colours."""
    coefficients = torch.tensor([absorption])
    body = solid([1.45]).with_absorption_coefficients(coefficients)
    save(photographs_of(body, sampler=Snell(branches="all")), tmp_path / "ball")
    options = ["experiment=glass", *TRAINING, "trainer.max_steps=300", f"data.root={tmp_path / 'ball'}"]
    train_here(*options, "evaluation=none", f"hydra.run.dir={tmp_path / 'run'}")
    learned = load(tmp_path / "run").renderer.scene.medium.absorption
    torch.testing.assert_close(learned, coefficients, rtol=0.1, atol=0.02)
