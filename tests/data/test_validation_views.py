"""Views that are held back: which, and that nobody trains on them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nerfro
from nerfro.data.base import Views
from nerfro.data.blender import BlenderData
from nerfro.data.validation_views import WithValidationViews, spread
from nerfro.training.ray_batches import RayBatches


def test_places_are_spread_and_the_outermost_are_left() -> None:
    line = np.stack([np.arange(9.0), np.zeros(9), np.zeros(9)], -1)
    assert spread(line, 1) == [4]
    groups = np.concatenate([line + shift for shift in np.diag([0, 100, 100])])
    assert spread(groups, 3) == [4, 13, 22], "the middle of each group"
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    gaps = np.diff([*(taken := spread(ring, 6)), taken[0] + 24])
    assert gaps.min() >= 2, "none beside another"
    assert spread(np.zeros((5, 3)), 3) == [0, 1, 2], "cameras in one place are taken once each"


def test_held_back_views_are_val_and_the_others_train(tiny_scene: Path) -> None:
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


def test_a_run_never_draws_what_it_holds_back(
    train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Views] = []
    make = RayBatches.__init__

    def spied(self: RayBatches, views: Views, *given: Any) -> None:
        drawn.append(views)
        make(self, views, *given)

    monkeypatch.setattr(RayBatches, "__init__", spied)
    run = [*tiny_default_run, f"hydra.run.dir={tmp_path / 'run'}", "trainer.max_steps=2", "evaluation.every=0"]
    finished = train_here(*run, "batches.num_validation_views=1")
    assert finished.code == 0, finished.err
    val = nerfro.load(tmp_path / "run", device="cpu").views("val")
    assert [len(views) for views in drawn] == [2]
    assert len(val) == 1
    assert not {frame.image for frame in drawn[0].frames} & {frame.image for frame in val.frames}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("3", "batches.num_validation_views=3 leaves no view to train on: there are 3 training views; take at most 2"),
        ("-1", "batches.num_validation_views=-1 is not allowed; take at least 0"),
        ("0.2", "Value '0.2' of type 'float' could not be converted to Integer"),
    ],
)
def test_numbers_that_cannot_be_held_back_are_refused_in_one_line(
    train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path, value: str, message: str
) -> None:
    finished = train_here(
        *tiny_default_run,
        "trainer.max_steps=1",
        f"hydra.run.dir={tmp_path / 'run'}",
        f"batches.num_validation_views={value}",
    )
    assert finished.code == 1
    assert message in finished.err
    assert finished.err.count("\n") == 1
