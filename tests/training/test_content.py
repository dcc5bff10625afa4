"""The space that a run covers, and the resolution of its background."""

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from nerfro.core.cameras import Cameras
from nerfro.media.analytic import Vacuum
from nerfro.registry.allowed import untyped
from nerfro.registry.registration import discover, find
from nerfro.training.angular_resolution import derive_angular_resolution
from nerfro.training.config import TrainConfig
from nerfro.training.content import common_target, derive_content, describe
from tests.exact_silhouettes import cameras_around

MIDDLE = np.array([0.4, -2.0, 1.0])


def around(num: int) -> Cameras:
    """Cameras that look at one place from a distance of 3, with 40 pixels of focal length."""
    cameras = cameras_around(num, 16, distance=3.0, focal=2.5)
    cameras.camera_to_world[..., 3] += torch.from_numpy(MIDDLE)
    return cameras


def of_all_space(**content: object) -> DictConfig:
    config = OmegaConf.structured(untyped(TrainConfig()))
    config.medium = {}
    config.content.space = "all"
    config.content.update(content)
    derive_content(config, Vacuum(), around(7))
    return config.content


def test_content_ball_lies_at_the_target_of_the_cameras() -> None:
    content = of_all_space()
    np.testing.assert_allclose(np.mean([content.box_min, content.box_max], axis=0), MIDDLE, atol=1e-4)
    assert content.radius == 1.5
    assert content.near == pytest.approx(0.9)
    # A pixel is 3 / 40 wide there, and contracted space 6; two cells a pixel.
    assert content.cells == pytest.approx(160, abs=1)
    assert of_all_space(radius=6.0).cells == pytest.approx(640, abs=1)
    assert of_all_space(radius=0.75).cells == 128  # 80 would be too few
    assert "contracted beyond 1.5 around (0.4, -2, 1)" in describe(content)


def test_explicit_settings_are_kept() -> None:
    given = {"box_min": [0.0, 0.0, 0.0], "box_max": [2.0, 2.0, 2.0], "radius": 5.0, "near": 0.0, "cells": 77}
    content = of_all_space(**given)
    assert {name: content[name] for name in given} == given


def test_parallel_cameras_have_a_default_depth() -> None:
    centres = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    forward = np.tile([0.0, 0.0, -1.0], (4, 1))
    np.testing.assert_allclose(common_target(centres, forward, 4.0), [0.5, 0.5, -4.0], atol=1e-9)


def test_content_in_a_box_needs_no_cameras() -> None:
    config = OmegaConf.structured(untyped(TrainConfig()))
    config.content.box_min, config.content.box_max = [0.0] * 3, [1.0] * 3
    derive_content(config, Vacuum())
    assert config.content.radius is None
    assert describe(config.content) == ""


@pytest.mark.parametrize(
    ("side", "fits", "given", "descent", "finest"),
    [
        (64, True, None, 128, 128),
        (128, True, None, 256, 256),
        (256, True, None, 256, 512),
        (256, False, None, 512, 512),
        (4000, True, None, 256, 1024),
        (4000, False, None, 512, 512),
        (256, True, [4, 32], 32, 32),
    ],
)
def test_finest_texel_follows_the_pixel(
    side: int, fits: bool, given: list[int] | None, descent: int, finest: int
) -> None:
    discover()
    cameras = cameras_around(3, side, focal=1.4)
    background = {"_target_": find("background", "envmap").target, "resolutions": given, "fitted_resolutions": None}
    config = OmegaConf.create({
        "background": background,
        "content": {"space": "box"},
        "loss": {"total_variation": {"weight": 1.0, "angle": None}},
        "phase": {"background": {"steps": 10 if fits else 0}},
    })  # fmt: skip
    derive_angular_resolution(config, cameras)
    assert max(config.background.resolutions) == descent
    assert max([*config.background.resolutions, *(config.background.fitted_resolutions or ())]) == finest
    if given is None and side < 4000 and fits:
        pixel = 57.3 / (1.4 * side)
        assert 2**-0.5 < (90 / finest) / pixel < 2**0.5
    assert config.loss.total_variation.angle == pytest.approx(2 * 90 / descent)
