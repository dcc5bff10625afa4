"""Validation views: their selection, and that training does not use them."""

from pathlib import Path

import numpy as np
import torch

import nerfro
from nerfro.data.base import WithValidationViews, spread
from nerfro.data.formats.transforms import BlenderData
from tests.conftest import Runner


def test_validation_views_are_spread_and_not_outermost() -> None:
    line = np.stack([np.arange(9.0), np.zeros(9), np.zeros(9)], -1)
    assert spread(line, 1) == [4]
    groups = np.concatenate([line + shift for shift in np.diag([0, 100, 100])])
    assert spread(groups, 3) == [4, 13, 22], "the middle of each group"
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    gaps = np.diff([*(taken := spread(ring, 6)), taken[0] + 24])
    assert gaps.min() >= 2, "none beside another"
    assert spread(np.zeros((5, 3)), 3) == [0, 1, 2], "cameras in one place are taken once each"


def test_held_out_views_become_the_val_split(tiny_scene: Path) -> None:
    source = BlenderData(str(tiny_scene), near=2.0, far=6.0)
    held = WithValidationViews(source, 1)
    whole, train, val = source.load("train"), held.load("train"), held.load("val")
    assert held.splits == ["train", "val", "test"]
    assert sorted([*train.names, *val.names]) == sorted(whole.names)
    assert len(val) == 1
    for part in (train, val):
        for index, name in enumerate(part.names):
            before = whole.names.index(name)
            assert torch.equal(part.images[index], whole.images[before])
            assert torch.equal(part.cameras.camera_to_world[index], whole.cameras.camera_to_world[before])
            assert part.frames[index].image == whole.frames[before].image
    assert held.load("test").names == source.load("test").names
    many = WithValidationViews(source, 2)
    assert many.load("train").names == val.names, "of many that are held back, those that train are spread"
    assert many.load("val").names == train.names


def test_training_draws_no_validation_views(unchecked: None, tiny_default_run: list[str]) -> None:
    options = [*tiny_default_run, "trainer.max_steps=1", "batches.num_validation_views=1"]
    _, data = nerfro.build(None, options)
    drawn, held = data.batches.cameras.camera_to_world, data.validation.cameras.camera_to_world
    assert (len(drawn), len(held)) == (2, 1)
    assert not (drawn == held).all((1, 2)).any()


def test_too_many_validation_views_are_refused(train: Runner) -> None:
    refused = train("trainer.max_steps=1", "batches.num_validation_views=3", code=1).error
    assert "=3 leaves no view to train on: there are 3 training views; take at most 2" in refused
