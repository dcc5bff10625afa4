"""Media are learned with any model and path sampler."""

from pathlib import Path

import pytest
import torch

from nerfro.paper.eikonal import Eikonal
from nerfro.registry.registration import discover, find
from nerfro.samplers.paths.snell import Snell
from nerfro.training.run_folder import load
from tests.ball_photographs import TRAINING, photographs, photographs_of, save, solid
from tests.closed_forms import make_rays
from tests.conftest import Runner, weights_of

FIELDS = {"width": 8, "depth": 2, "skip": 0}


@pytest.mark.slow
def test_medium_of_constant_index_learns_from_adaptive_paths() -> None:
    # At the start n is 1 everywhere and nothing bends, yet images must be able to say that something should.
    discover()
    medium = find("medium", "index_field").cls(**FIELDS)
    rays = make_rays([[-2.0, 0.3, 0.1], [-2.0, -0.2, 0.4]], [[1.0, 0, 0], [1.0, 0, 0]], 0.5, 4.0)
    sampler = Eikonal()
    path = sampler.replay(sampler(rays, medium), rays, medium)
    assert not path.refracted.any()
    path.exit_directions[:, 1].sum().backward()
    assert medium.last.weight.grad.abs().max() > 0


@pytest.mark.slow
def test_training_corrects_a_wrong_index(train_here: Runner, tmp_path: Path) -> None:
    save(photographs([1.45]), tmp_path / "ball")
    options = [*TRAINING, f"data.root={tmp_path / 'ball'}", f"medium.ior={1.02 * 1.45}", "medium.learn_ior=true"]
    options += ["optimizer.groups={bodies.*.ior: {learning_rate: 0.006, start: 60}}", "trainer.max_steps=220"]
    options += ["batches.subdivision.side=2"]
    train_here(*options, f"hydra.run.dir={tmp_path / 'run'}")
    found = weights_of(tmp_path / "run")["renderer.scene.medium.materials.0.ior"]
    assert found.item() == pytest.approx(
        1.45, rel=0.01
    )  # 1.462 from above and from below: the grid's ball is not the photographs'


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
