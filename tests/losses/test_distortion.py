"""The distortion loss against its definition."""

from unittest.mock import Mock

import pytest
import torch

from nerfro.core.types import Path, Rendering, Samples
from nerfro.losses.terms import Distortion, distortion
from nerfro.registry.registration import discover
from nerfro.rendering import Scene
from nerfro.testing import example_batch

discover()

SCENE = Mock(spec=Scene)


def random_intervals(num_rays: int, num_samples: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(num_rays, num_samples, generator=generator, dtype=dtype) ** 4
    edges = torch.rand(num_rays, num_samples + 1, generator=generator, dtype=dtype).cumsum(-1)
    return weights / weights.sum(-1, keepdim=True), edges / edges[:, -1:]


def double_loop(weights: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """Eqn. 15 of mip-NeRF 360 as it is written."""
    total = weights.new_zeros(len(weights))
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    for i in range(weights.shape[1]):
        for j in range(weights.shape[1]):
            total = total + weights[:, i] * weights[:, j] * (middle[:, i] - middle[:, j]).abs()
        total = total + weights[:, i] ** 2 * (edges[:, i + 1] - edges[:, i]) / 3
    return total


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_prefix_sums_equal_the_double_loop(dtype: torch.dtype, tolerance: float) -> None:
    weights, edges = random_intervals(7, 13, dtype)
    ours, reference = weights.clone().requires_grad_(), weights.clone().requires_grad_()
    value, expected = distortion(ours, edges), double_loop(reference, edges)
    torch.testing.assert_close(value, expected, rtol=tolerance, atol=0)
    value.sum().backward()
    expected.sum().backward()
    torch.testing.assert_close(ours.grad, reference.grad, rtol=tolerance, atol=tolerance)


def loss(weights: torch.Tensor, s: torch.Tensor, contracted_edges: torch.Tensor | None = None) -> torch.Tensor:
    """Of weights on intervals between arc lengths [5, 7], which may have other lengths in contracted space."""
    ends = s[:, [0, -1]]
    vectors = torch.zeros(5, 2, 3)
    path = Path.unbranched(vectors, vectors, ends, torch.zeros(5, dtype=torch.bool), torch.ones(5))
    positions = torch.zeros(5, 6, 3)
    samples = Samples(positions, positions, s[:, :-1], s, torch.ones(5), contracted_edges=contracted_edges)
    colour = torch.zeros(5, 3)
    rendering = Rendering(colour, weights, 1 - weights.sum(-1), colour, samples, path)
    return Distortion()([rendering], example_batch(len(colour)), SCENE)


def test_loss_is_invariant_to_scale_and_translation() -> None:
    weights, edges = random_intervals(5, 6, torch.float32)
    torch.testing.assert_close(loss(weights, edges), loss(weights, 2.0 + 30.0 * edges), rtol=1e-4, atol=0)


def test_distances_are_contracted_with_space() -> None:
    weights, edges = random_intervals(5, 6, torch.float32)
    edges[:, 0] = 0.0
    far_away = torch.tan(edges * 1.57)  # however long the last interval is
    weights = weights / weights.sum(-1, keepdim=True)  # nothing passes
    contracted = loss(weights, far_away, contracted_edges=3.0 * edges)
    torch.testing.assert_close(contracted, loss(weights, edges), rtol=1e-4, atol=0)


def test_transmitted_light_counts_at_infinity_in_all_space() -> None:
    edges = torch.linspace(0, 1, 7).expand(5, -1)
    half = torch.tensor([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]).expand(5, -1)
    # 2 x 1/2 x 1/2 x 3/4 between the two, and 1/3 x 1/4 x 1/6 within the first.
    assert float(loss(half, edges, contracted_edges=edges)) == pytest.approx(0.375 + 1 / 72, rel=1e-4)
    assert float(loss(half, edges)) == pytest.approx(1 / 72, rel=1e-4)  # a sky stands beyond the path
    assert float(loss(0 * half, edges, contracted_edges=edges)) == pytest.approx(0, abs=1e-6)
