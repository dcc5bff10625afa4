"""The loss of light that stops before what the cameras look at: it clears fog that no photograph contradicts."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from nerfro.losses.near_camera import NearCamera
from nerfro.rendering import Scene, composite
from nerfro.testing import example_batch, example_path
from nerfro.types import Path, Radiance, Rendering, Samples

SCENE = Mock(spec=Scene)

BATCH = example_batch(8)


def white_fog(path: Path, density: torch.Tensor) -> Rendering:
    """Fog of one density for each of 8 intervals between 0 and 8, white before white."""
    edges = torch.linspace(0, 8, 9).expand(8, -1)
    samples = Samples.along(path, 0.5 * (edges[:, 1:] + edges[:, :-1]), edges)
    return composite(samples, Radiance(density.expand(8, 8), torch.ones(8, 8, 3)), torch.ones(8, 3), path)


def loss_around(path: Path) -> NearCamera:
    """Of content 4 units before the first camera; all paths are taken to begin there."""
    middle = path.positions[0, 0] + 4 * path.directions[0, 0]
    return NearCamera((middle - 1).tolist(), (middle + 1).tolist())


def first_camera(path: Path) -> Path:
    positions = path.positions - path.positions[:, :1] + path.positions[:1, :1]
    return replace(path, positions=positions)


def test_white_fog_before_white_clears_where_it_is_near_alone() -> None:
    path = first_camera(example_path(8))
    raw = torch.full((8,), -1.0, requires_grad=True)
    optimizer, near_camera = torch.optim.Adam([raw], lr=0.1), loss_around(path)
    for _ in range(200):
        rendering = white_fog(path, raw.exp())
        loss = (1 - rendering.rgb).square().mean() + 0.1 * near_camera([rendering], BATCH, SCENE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (raw[:4].detach().exp() < 1e-2).all()
    assert (raw[4:].detach().exp() > 0.3).all()


@pytest.mark.parametrize(("interval", "counts"), [(0, 1 - 0.5 / 4), (2, 1 - 2.5 / 4), (4, 0.0), (7, 0.0)])
def test_a_wall_counts_by_how_near_it_is(interval: int, counts: float) -> None:
    path = first_camera(example_path(8))
    density = torch.zeros(8)
    density[interval] = 100.0
    found = loss_around(path)([white_fog(path, density)], BATCH, SCENE)
    assert float(found) == pytest.approx(counts, abs=1e-5)
