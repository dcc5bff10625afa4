"""The loss of light that passes the volume, and that it fills a hole that a black boundary would leave."""

from __future__ import annotations

from unittest.mock import Mock

import torch

from nerfro.losses.opaque import Opaque
from nerfro.rendering import Scene, composite
from nerfro.testing import example_batch, example_path
from nerfro.types import Radiance, Samples

SCENE = Mock(spec=Scene)


def learned_opacity(weight: float, num_steps: int = 200) -> float:
    """Mean opacity of one even density that has learned to look black before a black boundary."""
    path = example_path(8)
    edges = torch.linspace(2, 6, 9).expand(8, -1)
    samples = Samples.along(path, 0.5 * (edges[:, 1:] + edges[:, :-1]), edges)
    raw = torch.full((1,), -5.0, requires_grad=True)
    optimizer = torch.optim.Adam([raw], lr=0.1)
    batch = example_batch(8)
    for _ in range(num_steps):
        density = raw.exp().expand(8, 8)
        rendering = composite(samples, Radiance(density, torch.zeros(8, 8, 3)), torch.zeros(8, 3), path)
        loss = rendering.rgb.square().mean() + weight * Opaque()([rendering], batch, SCENE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return float(rendering.opacity.detach().mean())


def test_what_is_as_black_as_the_boundary_becomes_opaque() -> None:
    assert learned_opacity(0.0) < 0.05
    assert learned_opacity(0.1) > 0.95
