"""What each setting says about a run, and that resuming, sweeps and tables go by the same statement."""

import inspect

import lightning.pytorch as pl
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from nerfro.paths import CONF_DIR
from nerfro.registry import discover
from nerfro.training.config import TrainConfig
from nerfro.training.settings import _NAMED, RESUMING, Role, first_difference, role, settings


def test_every_setting_that_is_named_exists() -> None:
    discover()
    ConfigStore.instance().store(name="train_schema", node=TrainConfig, provider="nerfro")
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        config = compose("train")
    trainer = {f"trainer.{name}" for name in inspect.signature(pl.Trainer).parameters}
    media = {"medium.cache"}  # a field of some
    for name in set(_NAMED) - trainer - media:
        assert OmegaConf.select(config, name, default="absent") != "absent", name


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("field.width", Role.METHOD),
        ("trainer.precision", Role.METHOD),
        ("trainer.max_steps", Role.BUDGET),
        ("evaluation.subdivision.divergence", Role.SCORING),
        ("evaluation.every", Role.WATCHING),
        ("logger.wandb.name", Role.WATCHING),
        ("checkpoints", Role.METHOD),
    ],
)
def test_the_longest_name_decides(name: str, expected: Role) -> None:
    assert role(name) is expected


def test_settings_are_flat_and_their_first_difference_is_named() -> None:
    config = OmegaConf.create({"seed": 1, "field": {"width": 64, "levels": [1, 2]}, "logger": {"csv": {"name": "x"}}})
    flat = settings(config, RESUMING)
    assert flat == {"seed": 1, "field.width": 64, "field.levels": [1, 2]}
    assert first_difference(flat, dict(flat)) is None
    assert first_difference(flat, {**flat, "seed": 2, "field.bias": True}) == "field.bias"
