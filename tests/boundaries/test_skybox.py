"""The paper's boundary, and the constant one."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from nerfro.boundaries.constant import ConstantBoundary
from nerfro.boundaries.skybox import Skybox
from nerfro.errors import NerfroError
from nerfro.types import Exits


def test_published_skybox_has_its_layers() -> None:
    sky = Skybox()
    assert [(layer.in_features, layer.out_features) for layer in sky.trunk.layers] == [
        (27, 128),
        (128, 128),
        (128, 128),
        (128 + 27, 128),
    ]
    assert (sky.rgb.in_features, sky.rgb.out_features) == (128, 3)


def test_skybox_learns_a_smooth_sky() -> None:
    sky = Skybox(width=32)
    directions = normalize(torch.randn(2048, 3), dim=-1)
    target = 0.5 + 0.4 * directions
    optimizer = torch.optim.Adam(sky.parameters(), 1e-2)
    for _ in range(150):
        error = (sky(Exits(directions)) - target).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    unseen = normalize(torch.randn(500, 3), dim=-1)
    assert (sky(Exits(unseen)) - (0.5 + 0.4 * unseen)).square().mean() < 1e-3


def test_skybox_keeps_all_leading_axes() -> None:
    directions = normalize(torch.randn(4, 5, 3), dim=-1)
    sky = Skybox(width=8)
    torch.testing.assert_close(sky(Exits(directions))[2, 3], sky(Exits(directions[2, 3])))


def test_constant_boundary_is_the_same_in_every_direction() -> None:
    rgb = ConstantBoundary([0.1, 0.2, 0.3])(Exits(torch.randn(4, 5, 3)))
    assert torch.equal(rgb, torch.tensor([0.1, 0.2, 0.3]).expand(4, 5, 3))


def test_colour_of_other_than_three_numbers_is_refused() -> None:
    with pytest.raises(NerfroError, match="give three"):
        ConstantBoundary([1.0])
