"""Inverse transform sampling against its analytic distribution and against a slow loop."""

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.core.types import Path
from nerfro.paper.hierarchical import blur_weights
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import invert_cdf, spread_uniform
from nerfro.testing import example_draws
from tests.closed_forms import make_rays


def _paths(num: int) -> Path:
    return straight_path(make_rays(torch.zeros(num, 3), torch.randn(num, 3), 0, 1))


def slow_invert_cdf(edges: np.ndarray, weights: np.ndarray, u: float) -> float:
    """Walk through the bins until their share of the weight exceeds u, then interpolate inside the bin."""
    shares = weights / weights.sum()
    below = 0.0
    for i, share in enumerate(shares):
        if u < below + share:
            return edges[i] + (u - below) / share * (edges[i + 1] - edges[i])
        below += share
    return edges[-1]


def random_step_function(num_rays: int, num_bins: int) -> tuple[Tensor, Tensor]:
    """Edges that ascend unevenly and weights of which a quarter is zero."""
    edges = 2 + torch.rand(num_rays, num_bins + 1, dtype=torch.float64).cumsum(-1)
    weights = torch.rand(num_rays, num_bins, dtype=torch.float64)
    weights[torch.rand(num_rays, num_bins) < 0.25] = 0
    return edges, weights


def test_inverse_of_the_cumulative_distribution_equals_a_slow_loop() -> None:
    edges, weights = random_step_function(20, 9)
    u = torch.rand(20, 30, dtype=torch.float64)
    fast = invert_cdf(edges, weights, u)
    slow = [
        [slow_invert_cdf(edges[r].numpy(), weights[r].numpy(), float(u[r, i])) for i in range(30)] for r in range(20)
    ]
    torch.testing.assert_close(fast, torch.tensor(slow, dtype=torch.float64), rtol=0, atol=1e-9)


def test_samples_stay_inside_at_both_ends_of_u() -> None:
    edges, weights = random_step_function(50, 7)
    edges, weights = edges.float(), weights.float()
    u = torch.tensor([0.0, 1 - torch.finfo(torch.float32).eps]).expand(50, -1)
    s = invert_cdf(edges, weights, u)
    assert (s >= edges[:, :1]).all()
    assert (s <= edges[:, -1:]).all()


def test_ray_without_weight_is_sampled_uniformly() -> None:
    edges = torch.tensor([[2.0, 3, 4, 5, 6]])
    u = torch.linspace(0, 0.999, 50)[None]
    torch.testing.assert_close(invert_cdf(edges, torch.zeros(1, 4), u), 2 + 4 * u)


def test_blur_equals_a_slow_loop() -> None:
    weights = torch.rand(4, 11)
    slow = torch.empty_like(weights)
    for ray in range(4):
        for i in range(11):
            here, left, right = (weights[ray, j] for j in (i, max(i - 1, 0), min(i + 1, 10)))
            slow[ray, i] = 0.5 * (max(left, here) + max(here, right)) + 0.01
    torch.testing.assert_close(blur_weights(weights, 0.01), slow)


@pytest.mark.parametrize("num_samples", [1, 5, 64])
def test_random_u_has_one_draw_in_each_bin(num_samples: int) -> None:
    u = spread_uniform(_paths(100), num_samples, example_draws(100))
    assert ((u * num_samples).floor() == torch.arange(num_samples)).all()
    assert len(u.unique()) > 0.9 * u.numel()


def test_even_u_runs_from_zero_to_just_below_one() -> None:
    u = spread_uniform(_paths(2), 9, None)
    torch.testing.assert_close(u, torch.linspace(0, 1, 9, dtype=torch.float64).expand(2, -1))
    assert (u < 1).all()
