"""Which pixels one ray stands for."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from nerfro.cameras import Cameras
from nerfro.media.analytic import Vacuum
from nerfro.media.shapes import RoundedBox
from nerfro.samplers.divergence import divergent_pixels, exit_divergence
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


def test_rim_of_a_cube_diverges_and_its_face_does_not() -> None:
    cube = RoundedBox(half_side=0.6, edge_radius=0.05, ior=1.5)
    sampler = Snell()
    divergent = torch.zeros(SIDE * SIDE, dtype=torch.bool)
    divergent[divergent_pixels(lambda index, rays: sampler(rays, cube), camera(), 8.0)] = True
    divergent = divergent.view(SIDE, SIDE)
    # Half the top face's side in pixels; the rim lies there.
    rim = 0.6 * FOCAL / (4.0 - 0.6)
    offsets = (torch.arange(SIDE) + 0.5 - SIDE / 2).abs()
    away = torch.maximum(offsets[:, None], offsets)
    assert not divergent[away < rim - 3].any()
    assert not divergent[away > rim + 2].any()
    along = torch.minimum(offsets[:, None], offsets)  # corners apart, which are rounded twice
    assert divergent[((away - rim).abs() < 0.5) & (along < rim - 2)].all()


def test_straight_rays_do_not_diverge() -> None:
    assert len(divergent_pixels(lambda index, rays: Straight()(rays, Vacuum()), camera(), 1.1)) == 0
