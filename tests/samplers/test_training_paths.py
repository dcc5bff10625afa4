"""Paths of a batch, some of whose pixels are divided."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.media.analytic import Vacuum
from nerfro.media.shapes import RoundedBox
from nerfro.samplers.snell import Snell
from nerfro.samplers.training_paths import TrainingPaths
from nerfro.training.ray_batches import RayBatches

SIDE = 24


@pytest.fixture
def views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Views:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    pose = torch.eye(4)[:3].clone()
    pose[2, 3] = 4.0
    one = torch.ones(1)
    cameras = Cameras(pose[None], 60 * one, 60 * one, SIDE / 2 * one, SIDE / 2 * one, SIDE, SIDE, 2.0, 6.0)
    return Views(cameras, torch.rand(1, SIDE, SIDE, 3), None, ["r_0"])


def test_paths_of_whole_and_divided_pixels_are_the_traced_ones(views: Views) -> None:
    sampler, cube = Snell(), RoundedBox(half_side=0.6, edge_radius=0.1, ior=1.5)
    paths = TrainingPaths.build(sampler, cube, views.cameras, side=2, divergence=4.0)
    assert paths.parts is not None
    batch = RayBatches(views, 200).dividing(paths.parts).batch(0)
    assert batch.num_whole is not None
    assert 0 < batch.num_whole < 200
    known, traced = paths(batch), sampler(batch.rays, cube)
    s = torch.linspace(2.0, 6.0, 50).expand(len(batch.rays), -1)
    for a, b in zip(known.at(s), traced.at(s), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)
    torch.testing.assert_close(known.exit_directions, traced.exit_directions, rtol=0, atol=1e-5)
    assert torch.equal(known.refracted, traced.refracted)


@pytest.mark.parametrize("side", [1, 2])
def test_where_nothing_bends_no_pixel_is_divided(views: Views, side: int) -> None:
    paths = TrainingPaths.build(Snell(), Vacuum(), views.cameras, side)
    assert paths.parts is None
    batch = RayBatches(views, 50).batch(0)
    torch.testing.assert_close(paths(batch).exit_directions, batch.rays.directions)
