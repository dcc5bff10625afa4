"""Coarse samples, one in each bin; inverse transform sampling; and fine samples that follow the coarse weights."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfro.core.compositing import composite
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.types import FieldValues, Path, Rendering
from nerfro.paper.eikonal import Eikonal
from nerfro.paper.hierarchical import Hierarchical, blur_weights
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import LAST_FRACTION, Stratified, invert_cdf, midpoints, spread_uniform
from nerfro.testing import example_draws, example_path, example_rays
from tests.closed_forms import Luneburg, make_rays

NUM_VERTICES = 48


@pytest.fixture(scope="module")
def bent() -> Path:
    return Eikonal("euler", NUM_VERTICES)(example_rays(200), Luneburg())


def fractions(path: Path, s: torch.Tensor) -> torch.Tensor:
    return (s - path.near[:, None]) / (path.far - path.near)[:, None]


def test_training_draws_one_sample_from_each_bin(bent: Path) -> None:
    samples = Stratified(16)(bent, None, example_draws(200))
    place = fractions(bent, samples.s) * 16 - torch.arange(16)
    assert (place > -1e-4).all()
    assert (place < 1 + 1e-4).all()
    # Uniform in the bin: mean 1/2 within 5 standard errors, and rays differ from each other.
    assert abs(place.mean() - 0.5) < 5 / math.sqrt(12 * place.numel())
    assert (place.std(0) > 0.2).all()


@pytest.mark.parametrize("offset", [0.5, 0.0])
def test_evaluation_takes_one_position_in_each_bin(bent: Path, offset: float) -> None:
    samples = Stratified(16, offset=offset)(bent, None)
    expected = ((torch.arange(16) + offset) / 16).expand(200, -1)
    torch.testing.assert_close(fractions(bent, samples.s), expected, atol=1e-5, rtol=0)


def test_intervals_reach_from_sample_to_sample_and_the_last_is_thin(bent: Path) -> None:
    samples = Stratified(16)(bent, None, example_draws(200))
    torch.testing.assert_close(samples.deltas[:, :-1], samples.s.diff(dim=1))
    torch.testing.assert_close(samples.deltas[:, -1], LAST_FRACTION * (bent.far - bent.near), atol=1e-6, rtol=0)


def test_vertices_are_drawn_one_from_each_group_with_offsets_that_differ_between_rays(bent: Path) -> None:
    samples = Stratified(8, draw="vertices")(bent, None, example_draws(200))
    distance = (samples.positions[:, :, None] - bent.positions[:, None]).norm(dim=-1)
    nearest, vertex = distance.min(-1)
    assert (nearest == 0).all(), "every sample is a vertex"
    steps = NUM_VERTICES // 8
    assert (vertex // steps == torch.arange(8)).all()
    for group in range(8):
        assert (vertex[:, group] % steps).unique().tolist() == list(range(steps))
    torch.testing.assert_close(samples.directions, bent.directions.gather(1, vertex[..., None].expand(-1, -1, 3)))


@pytest.mark.parametrize(("offset", "picked"), [(0.5, 3), (0.0, 0)])
def test_evaluation_draws_the_same_vertex_of_each_group(bent: Path, offset: float, picked: int) -> None:
    samples = Stratified(8, draw="vertices", offset=offset)(bent, None)
    torch.testing.assert_close(samples.positions, bent.positions[:, picked :: NUM_VERTICES // 8], rtol=0, atol=0)
    torch.testing.assert_close(samples.s, bent.s[:, picked :: NUM_VERTICES // 8], rtol=0, atol=0)


def test_vertices_that_cannot_be_shared_out_evenly_are_refused(bent: Path) -> None:
    message = r"multiple of 7 path vertices, this path has 48; set sampler\.path\.num_steps"
    with pytest.raises(NerfroError, match=message):
        Stratified(7, draw="vertices")(bent, None)


def test_cones_fill_the_path_without_gaps() -> None:
    path = straight_path(example_rays())
    for draws in (example_draws(), None):
        samples = Stratified(16, cast="cones")(path, None, draws)
        assert (samples.deltas > 0).all()
        torch.testing.assert_close(samples.s, 0.5 * (samples.edges[:, 1:] + samples.edges[:, :-1]))
        within = 0.5 / 16 + 1e-5 if draws else 1e-5
        even = torch.linspace(0, 1, 17)
        assert (fractions(path, samples.edges) - even).abs().max() <= within


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


def render(path: Path, sampler: Hierarchical, weights: Tensor) -> Rendering:
    """A coarse rendering whose weights are the given ones."""
    samples = sampler(path, None)
    values = FieldValues(torch.ones_like(samples.s), torch.zeros_like(samples.positions))
    rendering = composite(samples, values, torch.zeros(len(path.s), 3), path)
    return replace(rendering, weights=weights.expand_as(samples.s))


def fine_lengths(sampler: Hierarchical, path: Path, coarse: Rendering, draws: Draws | None = None) -> Tensor:
    """Arc lengths of the fine samples, without the coarse ones."""
    rows = zip(sampler(path, coarse, draws).s, coarse.samples.s, strict=True)
    return torch.stack([s[~torch.isin(s, known)] for s, known in rows])


def spike(num_samples: int, index: int) -> Tensor:
    weights = torch.zeros(num_samples)
    weights[index] = 1.0
    return weights


@pytest.mark.parametrize("draws", [None, example_draws()])
def test_all_fine_samples_lie_around_the_single_weighted_sample(draws: Draws | None) -> None:
    path = example_path()
    sampler = Hierarchical(16, 32)
    coarse = render(path, sampler, spike(16, 9))
    fine = fine_lengths(sampler, path, coarse, draws)
    bins = midpoints(coarse.samples.s)
    assert fine.shape == (len(path.s), 32)
    assert (fine >= bins[:, 8:9] - 1e-5).all()
    assert (fine <= bins[:, 9:10] + 1e-5).all()


def test_fine_samples_are_proportional_to_the_weights() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(8, 1000)
    weights = torch.tensor([9.0, 1, 0, 3, 0, 0, 4, 9])  # the first and the last have no bin of their own
    coarse = render(path, sampler, weights)
    bins = midpoints(coarse.samples.s)
    fine = fine_lengths(sampler, path, coarse)
    for i, weight in enumerate(weights[1:-1]):
        inside = ((fine >= bins[:, i : i + 1]) & (fine < bins[:, i + 1 : i + 2])).sum(1)
        assert (inside - 1000 * weight / 8).abs().max() <= 2


def test_union_contains_every_coarse_sample_and_is_sorted() -> None:
    path = example_path()
    sampler = Hierarchical(16, 24)
    coarse = render(path, sampler, torch.rand(16))
    fine = sampler(path, coarse, example_draws())
    assert fine.s.shape == (len(path.s), 40)
    assert (fine.s.diff(dim=1) >= 0).all()
    assert ((fine.s[:, None] - coarse.samples.s[..., None]).abs().min(-1).values == 0).all()


def test_sample_positions_have_no_gradient() -> None:
    path = example_path()
    sampler = Hierarchical(16, 24)
    weights = torch.rand(16, requires_grad=True)
    assert not sampler(path, render(path, sampler, weights)).s.requires_grad


def test_cones_are_redrawn_between_edges_with_max_blur_and_padding() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(16, 400, cast="cones")
    coarse = render(path, sampler, spike(16, 5))
    fine = sampler(path, coarse)
    assert fine.edges.shape == (len(path.s), 401)
    # The blur gives half of the weight of the spike to each neighbour, and 0.01 is added to each of the 16 bins.
    for i, weight in ((3, 0.01), (4, 0.51), (5, 1.01), (6, 0.51), (7, 0.01)):
        inside = (fine.s >= coarse.samples.edges[:, i : i + 1]) & (fine.s < coarse.samples.edges[:, i + 1 : i + 2])
        assert (inside.sum(1) - 400 * weight / 2.16).abs().max() <= 2
