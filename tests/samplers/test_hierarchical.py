"""Fine samples follow the weights of the coarse rendering."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.types import FieldValues, Path, Rendering
from nerfro.paper.hierarchical import Hierarchical
from nerfro.rendering import composite
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import midpoints
from nerfro.testing import example_draws, example_path, example_rays


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
