"""The meaning of settings for resuming, sweeps and tables."""

import inspect

import lightning.pytorch as pl
from omegaconf import OmegaConf

from nerfro.training.settings import _NAMED, RESUMING, first_difference, settings
from tests.conftest import composed


def test_every_setting_that_is_named_exists() -> None:
    config = composed()
    trainer = {f"trainer.{name}" for name in inspect.signature(pl.Trainer).parameters}
    media = {"medium.cache"}  # a field of some
    for name in set(_NAMED) - trainer - media:
        assert OmegaConf.select(config, name, default="absent") != "absent", name


def test_settings_are_flat_and_their_first_difference_is_named() -> None:
    flat = {"seed": 1, "field.width": 64, "field.levels": [1, 2], "checkpoints": "no group of watching"}
    watching = ("logger.csv.name=x", "checkpoint.every_steps=3", "evaluation.every=9", "trainer.profiler=simple")
    config = OmegaConf.from_dotlist([*(f"{name}={value}" for name, value in flat.items()), *watching])
    assert settings(config, RESUMING) == flat
    assert first_difference(flat, dict(flat)) is None
    assert first_difference(flat, {**flat, "seed": 2, "field.bias": True}) == "field.bias"
