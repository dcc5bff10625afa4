"""Coarse to fine: levels of detail that are not shown yet are as if they held nothing, and learn nothing."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.types import Exits


def test_a_coarse_sky_is_the_sum_of_its_coarse_levels() -> None:
    sky, exits = EnvironmentMap([4, 8, 16, 32]), Exits(normalize(torch.randn(200, 3), dim=-1))
    torch.nn.init.normal_(sky.texels)
    whole = sky.eval()(exits)
    sky.train().detail = 0.5
    coarse = sky(exits)
    coarse.sum().backward()
    shown = sky.levels.coarsest(0.5).num_texels
    assert sky.levels.coarsest(0.5).resolutions == (4, 8)
    assert bool((sky.texels.grad[:shown] != 0).any())
    assert bool((sky.texels.grad[shown:] == 0).all())
    torch.testing.assert_close(sky.eval()(exits), whole)  # pictures show all
    with torch.no_grad():
        sky.texels[shown:] = 0
    torch.testing.assert_close(sky(exits), coarse)
