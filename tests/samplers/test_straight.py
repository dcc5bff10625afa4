"""Straight paths."""

import torch

from nerfro.core.types import Rays
from nerfro.samplers.base import Straight
from tests.closed_forms import Ball


def test_path_is_the_line_from_near_to_far_in_any_medium() -> None:
    origins = torch.randn(5, 3)
    directions = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
    near, far = torch.rand(5), 4 + torch.rand(5)
    path = Straight()(Rays(origins, directions, torch.ones(5), near, far), Ball())
    torch.testing.assert_close(path.near, near)
    torch.testing.assert_close(path.far, far)
    s = torch.linspace(0, 1, 7) * (far - near)[:, None] + near[:, None]
    positions, along = path.at(s)
    torch.testing.assert_close(positions, origins[:, None] + s[..., None] * directions[:, None])
    torch.testing.assert_close(along, directions[:, None].expand(-1, 7, -1))
    torch.testing.assert_close(path.exit_directions, directions)
    assert not path.refracted.any()
