"""Parameters that a run leaves unchanged, and the step at which a background begins to learn."""

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.training.checks import Updates
from tests.conftest import Runner, composed


def test_warnings_name_each_unchanged_parameter_once(capsys: pytest.CaptureFixture[str]) -> None:
    parameters = {name: torch.nn.Parameter(torch.ones(3)) for name in ("learned", "late", "clipped", "frozen")}
    parameters["frozen"].requires_grad_(False)
    updates = Updates(parameters)
    updates.warn_of_late_starts(5, {own: 5 * (name == "late") for name, own in parameters.items()})
    assert capsys.readouterr().out == (
        "nerfro: warning: late keeps the initial values in this run, because optimizer.groups starts at step 5, and "
        "trainer.max_steps=5\n"
    )
    with torch.no_grad():
        parameters["learned"][1] += 1e-6
    updates.warn_of_unchanged()
    assert capsys.readouterr().out.startswith("nerfro: warning: clipped keeps the initial values in this run, because")


def test_only_a_background_that_a_phase_fits_starts_late() -> None:
    options = [], ["phase.background.steps=0"], ["~phase.background"], ["content.space=unbounded"]
    assert [EnvironmentMap.learns_from(composed(*overrides)) for overrides in options] == [100, 0, 0, 0]


def test_run_warns_of_groups_that_start_after_its_end(train: Runner, tmp_path: Path) -> None:
    late = "optimizer.groups={fields.*: {start: 2}}"
    finished = train("trainer.max_steps=2", "evaluation=none", "evaluation.every=0", late)
    (line,) = (line for line in finished.out.splitlines() if "keep" in line)
    assert line.startswith("nerfro: warning: fields.0.")
    assert "starts at step 2, and trainer.max_steps=2" in line
    config = OmegaConf.load(tmp_path / "run" / "config.yaml")
    assert config.optimizer.groups["background.*"].start == 100
