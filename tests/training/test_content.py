"""Which space a run covers: from Eikonal Fields' file, or found from cameras."""

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from nerfro.cameras import Cameras
from nerfro.media.analytic import Vacuum
from nerfro.training.config import TrainConfig
from nerfro.training.content import common_target, describe, settle_content

MIDDLE = np.array([0.4, -2.0, 1.0])


def around(num: int, distance: float = 3.0) -> Cameras:
    """Cameras on a sphere that look at one place, with 40 pixels of focal length."""
    generator = np.random.default_rng(2)
    back = generator.normal(size=(num, 3))
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross(generator.normal(size=(num, 3)), back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    pose = np.stack([right, np.cross(back, right), back, MIDDLE + distance * back], -1)
    focal, centre = torch.full((num,), 40.0), torch.full((num,), 8.0)
    return Cameras(torch.tensor(pose).float(), focal, focal, centre, centre, 16, 16, 0.5, 5.0)


def of_all_space(**content: object) -> DictConfig:
    config = OmegaConf.structured(TrainConfig)
    config.medium = {}
    config.content.space = "all"
    config.content.update(content)
    settle_content(config, Vacuum(), around(7))
    return config.content


def test_ball_lies_where_the_cameras_look() -> None:
    content = of_all_space()
    np.testing.assert_allclose(np.mean([content.box_min, content.box_max], axis=0), MIDDLE, atol=1e-4)
    assert content.radius == 1.5
    assert content.near == pytest.approx(0.9)
    # A pixel is 3 / 40 wide there, and contracted space 6; two cells a pixel.
    assert content.cells == pytest.approx(160, abs=1)
    assert of_all_space(radius=6.0).cells == pytest.approx(640, abs=1)
    assert of_all_space(radius=0.75).cells == 128  # 80 would be too few
    assert "contracted beyond 1.5 around (0.4, -2, 1)" in describe(content)


def test_what_is_given_is_kept() -> None:
    given = {"box_min": [0.0, 0.0, 0.0], "box_max": [2.0, 2.0, 2.0], "radius": 5.0, "near": 0.0, "cells": 77}
    content = of_all_space(**given)
    assert {name: content[name] for name in given} == given


def test_axes_that_are_parallel_are_followed_to_a_usual_depth() -> None:
    centres = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    forward = np.tile([0.0, 0.0, -1.0], (4, 1))
    np.testing.assert_allclose(common_target(centres, forward, 4.0), [0.5, 0.5, -4.0], atol=1e-9)


def test_a_box_covers_nothing_else_and_needs_no_cameras() -> None:
    config = OmegaConf.structured(TrainConfig)
    config.content.box_min, config.content.box_max = [0.0] * 3, [1.0] * 3
    settle_content(config, Vacuum())
    assert config.content.radius is None
    assert describe(config.content) == ""
