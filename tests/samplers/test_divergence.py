"""Which pixels one ray stands for."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from nerfro.data.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.media.analytic import Vacuum
from nerfro.media.shapes import RoundedBox
from nerfro.samplers.divergence import exit_divergence, steady_pixels
from nerfro.samplers.snell import Snell
from nerfro.samplers.straight import Straight

SIDE = 33
FOCAL = 60.0


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))


def camera() -> Cameras:
    """Looks down on a cube from 4 units above."""
    pose = torch.eye(4)[:3].clone()
    pose[2, 3] = 4.0
    one = torch.ones(1)
    return Cameras(pose[None], FOCAL * one, FOCAL * one, SIDE / 2 * one, SIDE / 2 * one, SIDE, SIDE, 2.0, 6.0)


def test_divergence_is_the_largest_angle_to_a_neighbour() -> None:
    angles = torch.zeros(3, 4)
    angles[1, 2] = 0.3
    directions = torch.stack([angles.sin(), torch.zeros(3, 4), angles.cos()], -1)
    expected = torch.zeros(3, 4)
    expected[1, 1:] = expected[0, 2] = expected[2, 2] = 0.3
    torch.testing.assert_close(exit_divergence(directions), expected)


def test_edges_of_a_cube_are_not_steady_and_its_faces_are() -> None:
    cube = RoundedBox(half_side=0.6, edge_radius=0.05, ior=1.5)
    sampler = Snell()
    steady = steady_pixels(lambda index, rays: sampler(rays, cube), camera(), 8.0)[0]
    # Half the top face's side in pixels; the rim lies there.
    rim = 0.6 * FOCAL / (4.0 - 0.6)
    offsets = (torch.arange(SIDE) + 0.5 - SIDE / 2).abs()
    away = torch.maximum(offsets[:, None], offsets)
    assert steady[away < rim - 3].all()
    assert steady[away > rim + 2].all()
    along = torch.minimum(offsets[:, None], offsets)  # corners apart, which are rounded twice
    assert not steady[((away - rim).abs() < 0.5) & (along < rim - 2)].any()


def test_straight_rays_are_steady() -> None:
    steady = steady_pixels(lambda index, rays: Straight()(rays, Vacuum()), camera(), 1.1)
    assert steady.shape == (1, SIDE, SIDE)
    assert steady.all()


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan])
def test_a_limit_that_leaves_nothing_is_refused(limit: float) -> None:
    with pytest.raises(NerfroError, match="max_divergence"):
        steady_pixels(lambda index, rays: Straight()(rays, Vacuum()), camera(), limit)
