"""Losses for ambiguous content: empty, opaque or near fog in front of a backdrop of the same colour."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from nerfro.core.compositing import composite
from nerfro.core.types import FieldValues, Path, Rays, Rendering, Samples
from nerfro.losses.base import Loss
from nerfro.losses.terms import Backdrop, NearCamera, Opaque
from nerfro.rendering import Scene
from nerfro.samplers.base import Straight
from nerfro.testing import example_batch, example_path, example_space
from tests.closed_forms import Ball

SCENE = Mock(spec=Scene, space=example_space())

WHITE = [1.0, 1.0, 1.0]


def learned_opacity(seen: torch.Tensor, loss: Loss, start: float = 1.0, num_steps: int = 200) -> float:
    """Mean opacity of one even white density before white, that has learned from pixels of one colour."""
    path = example_path(8)
    edges = torch.linspace(2, 6, 9).expand(8, -1)
    samples = Samples.along(path, 0.5 * (edges[:, 1:] + edges[:, :-1]), edges)
    raw = torch.full((1,), start, requires_grad=True)
    optimizer = torch.optim.Adam([raw], lr=0.1)
    batch = replace(example_batch(8), rgb=seen.expand(8, 3))
    for _ in range(num_steps):
        density = raw.exp().expand(8, 8)
        rendering = composite(samples, FieldValues(density, torch.ones(8, 8, 3)), torch.ones(8, 3), path)
        error = (rendering.radiance - 1).square().mean()
        total = error + loss.weight * loss([rendering], batch, SCENE)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    return float(rendering.opacity.detach().mean())


def test_white_content_before_white_becomes_empty() -> None:
    uncharged = Backdrop(WHITE)
    uncharged.weight = 0.0
    assert learned_opacity(torch.ones(3), uncharged) > 0.95
    assert learned_opacity(torch.ones(3), Backdrop(WHITE)) < 0.05


def test_content_as_white_as_the_background_becomes_opaque() -> None:
    uncharged, charged = Opaque(), Opaque()
    uncharged.weight, charged.weight = 0.0, 0.1
    assert learned_opacity(torch.ones(3), uncharged, start=-5.0) < 0.05
    assert learned_opacity(torch.ones(3), charged, start=-5.0) > 0.95


def test_pixels_of_another_colour_and_photographs_without_a_backdrop_are_not_penalized() -> None:
    assert learned_opacity(torch.tensor([1.0, 1.0, 0.98]), Backdrop(WHITE)) > 0.95
    assert learned_opacity(torch.ones(3), Backdrop()) > 0.95


BATCH = example_batch(8)


def white_fog(path: Path, density: torch.Tensor) -> Rendering:
    """Fog of one density for each of 8 intervals between 0 and 8, white before white."""
    edges = torch.linspace(0, 8, 9).expand(8, -1)
    samples = Samples.along(path, 0.5 * (edges[:, 1:] + edges[:, :-1]), edges)
    return composite(samples, FieldValues(density.expand(8, 8), torch.ones(8, 8, 3)), torch.ones(8, 3), path)


CONTENT = NearCamera()


def straight_paths(near: float = 0.0) -> Path:
    """Return eight straight paths of a camera 4 units before the content, which begin at arc length `near`."""
    eight = torch.ones(8)
    origins, directions = torch.tensor([0.0, 0.0, 4.0]).expand(8, 3), torch.tensor([0.0, 0.0, -1.0]).expand(8, 3)
    return Straight()(Rays(origins, directions, 1e-3 * eight, near * eight, 8 * eight), Ball())


def test_near_camera_loss_removes_only_near_fog() -> None:
    path = straight_paths()
    raw = torch.full((8,), -1.0, requires_grad=True)
    optimizer = torch.optim.Adam([raw], lr=0.1)
    for _ in range(200):
        rendering = white_fog(path, raw.exp())
        loss = (1 - rendering.radiance).square().mean() + 0.1 * CONTENT([rendering], BATCH, SCENE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (raw[:2].detach().exp() < 1e-2).all()
    assert (raw[2:].detach().exp() > 0.3).all()


@pytest.mark.parametrize(("interval", "closeness"), [(0, 1 - 0.5 / 2), (1, 1 - 1.5 / 2), (2, 0.0), (7, 0.0)])
@pytest.mark.parametrize("near", [0.0, 1.5])
def test_near_camera_loss_decreases_with_the_distance_from_the_camera(
    interval: int, closeness: float, near: float
) -> None:
    path = straight_paths(near)
    density = torch.zeros(8)
    density[interval] = 100.0
    found = CONTENT([white_fog(path, density)], BATCH, SCENE)
    assert float(found) == pytest.approx(closeness, abs=1e-5)
