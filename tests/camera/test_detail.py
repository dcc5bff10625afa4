"""Coarse to fine: levels of detail that are not shown yet are as if they held nothing, and learn nothing."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.fields.hash_grid import HashGridField
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


def test_a_coarse_hash_grid_has_zeros_for_its_fine_levels() -> None:
    field, places = HashGridField(num_levels=6, log2_table_size=10), 2 * torch.rand(200, 3) - 1
    torch.nn.init.normal_(field.table)
    whole = field.eval().encode(places)
    field.train().detail = 0.5
    coarse = field.encode(places)
    assert coarse.shape == whole.shape
    torch.testing.assert_close(coarse[:, :6], whole[:, :6])
    assert bool((coarse[:, 6:] == 0).all())
