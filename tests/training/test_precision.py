"""Every precision that the trainer offers on a CPU trains, and is scored."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.parametrize(("precision", "model"), [("64-true", "tiny_default_run"), ("bf16-mixed", "tiny_run")])
def test_a_run_ends_with_finite_scores(
    precision: str, model: str, request: pytest.FixtureRequest, train_here: Callable[..., Any], tmp_path: Path
) -> None:
    options = [option for option in request.getfixturevalue(model) if "precision" not in option]
    train_here(*options, "trainer.max_steps=2", f"trainer.precision={precision}", f"hydra.run.dir={tmp_path / 'run'}")
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]
    assert all(math.isfinite(value) for value in scores.values() if isinstance(value, float))
