"""Losses that decide what no photograph decides: whether white before white is empty or opaque."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from nerfro.errors import NerfroError
from nerfro.losses.backdrop import Backdrop
from nerfro.losses.base import Loss
from nerfro.losses.opaque import Opaque
from nerfro.rendering import Scene, composite
from nerfro.testing import example_batch, example_path
from nerfro.types import Radiance, Samples

SCENE = Mock(spec=Scene)

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
        rendering = composite(samples, Radiance(density, torch.ones(8, 8, 3)), torch.ones(8, 3), path)
        error = (rendering.rgb - 1).square().mean()
        total = error + loss.weight * loss([rendering], batch, SCENE)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    return float(rendering.opacity.detach().mean())


def test_white_before_white_becomes_empty() -> None:
    uncharged = Backdrop(WHITE)
    uncharged.weight = 0.0
    assert learned_opacity(torch.ones(3), uncharged) > 0.95
    assert learned_opacity(torch.ones(3), Backdrop(WHITE)) < 0.05


def test_what_is_as_white_as_the_boundary_becomes_opaque() -> None:
    uncharged, charged = Opaque(), Opaque()
    uncharged.weight, charged.weight = 0.0, 0.1
    assert learned_opacity(torch.ones(3), uncharged, start=-5.0) < 0.05
    assert learned_opacity(torch.ones(3), charged, start=-5.0) > 0.95


def test_pixels_of_another_colour_and_photographs_without_a_backdrop_are_not_charged() -> None:
    assert learned_opacity(torch.tensor([1.0, 1.0, 0.98]), Backdrop(WHITE)) > 0.95
    assert learned_opacity(torch.ones(3), Backdrop()) > 0.95


@pytest.mark.parametrize("colour", [[1.0], [255.0, 255.0, 255.0]])
def test_a_colour_has_three_numbers_up_to_one(colour: list[float]) -> None:
    with pytest.raises(NerfroError, match="three numbers in"):
        Backdrop(colour)
