"""Settings of the command line take effect, or a warning names the setting that makes them ineffective."""

import re

import pytest

from nerfro.training.effects import settings_without_effect
from tests.conftest import composed


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+experiment=straight", "medium.learn_ior=true"], "medium.learn_ior=True .* with sampler/path=straight"),
        (["+experiment=mipnerf", "medium.learn_absorption=true"], "change sampler/path"),
        (["sampler.path.least_weight=0.1"], "with sampler.path.branches=none; .* sampler.path.branches=first or all"),
        (["sampler/path=eikonal", "sampler.path.num_steps=64"], "sampler.path.integrator=euler"),
        (["phase.cameras.every=20"], "has no effect with camera=given; remove it, or choose camera=refined"),
        (["phase={cameras: {start: 5}}"], "phase.cameras.start=5 has no effect"),
        (["+experiment=straight", "phase.background.steps=20"], "content.space=all"),
        (
            ["background=skybox", "phase.background.steps=20"],
            "background=skybox; remove it, or choose background=envmap",
        ),
        (["phase.background.steps=0", "phase.background.start=50"], "phase.background.steps=0"),
        (["content.radius=2"], "content.space=box"),
        (["batches.precrop_fraction=0.3"], "batches.precrop_steps=0"),
        (["optimizer.warmup_steps=0", "optimizer.warmup_factor=0.5"], "optimizer.warmup_steps=0"),
        (["trainer.gradient_clip_algorithm=value"], "trainer.gradient_clip_val=null"),
    ],
)
def test_setting_without_effect_is_reported(overrides: list[str], message: str) -> None:
    [line] = settings_without_effect(composed(*overrides), overrides)
    assert re.search(message, line)


@pytest.mark.parametrize(
    "overrides",
    [
        ["+experiment=straight", "medium.learn_ior=false", "content.radius=2", "phase.background.steps=0"],
        ["+experiment=glass_room", "sampler.path.branches=none"],  # the experiment has a value, the user has none
        ["+experiment=unknown", "medium.learn_ior=true", "sampler.path.least_weight=0.1"],
        ["sampler/path=eikonal", "sampler.path.integrator=euler", "sampler.path.num_steps=64"],
        ["camera=refined", "phase.cameras.every=20", "phase.background={steps: 20, start: 100}"],
        ["optimizer.groups={background.*: {start: 0}}", "loss.background={weight: 0.1, start: 5}", "hydra.run.dir=out"],
        ["trainer.gradient_clip_algorithm=value", "trainer.gradient_clip_val=0.1", "~phase.cameras"],
        ["logger=wandb", "logger.wandb.offline=true"],
    ],
)
def test_setting_with_effect_or_in_its_default_state_is_accepted(overrides: list[str]) -> None:
    assert settings_without_effect(composed(*overrides), overrides) == []
