"""The boundary's total variation."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from nerfro.errors import NerfroError
from nerfro.losses.total_variation import TotalVariation, direction_pairs
from nerfro.rendering import ColourSpace, Scene
from nerfro.testing import example_batch, example_draws

BATCH = example_batch()


def test_pairs_are_the_angle_apart_and_uniform() -> None:
    first, second = direction_pairs(torch.rand(20_000, 3), 0.3)
    for directions in (first, second):
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(20_000))
        # A uniform direction has mean 0 and covariance 1/3; the means scatter by 0.004.
        assert directions.mean(0).abs().max() < 0.02
        torch.testing.assert_close(directions.T @ directions / 20_000, torch.eye(3) / 3, rtol=0, atol=0.02)
    torch.testing.assert_close((first * second).sum(-1), torch.full((20_000,), math.cos(0.3)), rtol=0, atol=1e-5)


def scene(boundary) -> Mock:
    return Mock(spec=Scene, boundary=boundary, colour_space=ColourSpace.SRGB)


def test_value_is_that_of_a_linear_sky() -> None:
    # For C = d . a the mean of |C(d') - C(d)| is angle |a| / 2, the mean of |cos| over the sphere, to second order.
    sky = scene(lambda exits: (exits.directions * 0.8).sum(-1, keepdim=True).expand(-1, 3) * 0.5 / math.sqrt(3))
    loss = TotalVariation(angle=1.0)
    values = [float(loss([], replace(BATCH, draws=example_draws(step=step)), sky)) for step in range(30)]
    # The mean over 30 steps of 1024 pairs scatters by 0.3 %.
    assert sum(values) / len(values) == pytest.approx(math.radians(1.0) * 0.4 / 2, rel=0.02)


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(NerfroError, match="more than 0 and less than 90"):
        TotalVariation(angle=0.0)
