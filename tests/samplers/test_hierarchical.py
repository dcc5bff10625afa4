"""Fine samples go where the coarse rendering has weight."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfro.draws import Draws
from nerfro.errors import NerfroError
from nerfro.rendering import composite
from nerfro.samplers.paths.straight import straight_path
from nerfro.samplers.points.hierarchical import Hierarchical
from nerfro.samplers.points.stepfun import midpoints
from nerfro.testing import example_draws, example_path, example_rays
from nerfro.types import Path, Radiance, Rendering


def render(path: Path, sampler: Hierarchical, weights: Tensor) -> Rendering:
    """A coarse rendering whose weights are the given ones."""
    samples = sampler(path, None)
    radiance = Radiance(torch.ones_like(samples.s), torch.zeros_like(samples.positions))
    rendering = composite(samples, radiance, torch.zeros(len(path.s), 3), path)
    return replace(rendering, weights=weights.expand_as(samples.s))


def spike(num_samples: int, index: int) -> Tensor:
    weights = torch.zeros(num_samples)
    weights[index] = 1.0
    return weights


@pytest.mark.parametrize("draws", [None, example_draws()])
def test_all_fine_samples_fall_around_the_one_sample_with_weight(draws: Draws | None) -> None:
    path = example_path()
    sampler = Hierarchical(16, 32, union=False)
    coarse = render(path, sampler, spike(16, 9))
    fine = sampler(path, coarse, draws)
    bins = midpoints(coarse.samples.s)
    assert fine.s.shape == (len(path.s), 32)
    assert (fine.s >= bins[:, 8:9] - 1e-5).all()
    assert (fine.s <= bins[:, 9:10] + 1e-5).all()


def test_fine_samples_are_shared_out_in_proportion_to_the_weights() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(8, 1000, union=False)
    weights = torch.tensor([9.0, 1, 0, 3, 0, 0, 4, 9])  # the first and the last have no bin of their own
    coarse = render(path, sampler, weights)
    bins = midpoints(coarse.samples.s)
    fine = sampler(path, coarse).s
    for i, weight in enumerate(weights[1:-1]):
        inside = ((fine >= bins[:, i : i + 1]) & (fine < bins[:, i + 1 : i + 2])).sum(1)
        assert (inside - 1000 * weight / 8).abs().max() <= 2


def test_union_holds_every_coarse_sample_and_is_sorted() -> None:
    path = example_path()
    sampler = Hierarchical(16, 24)
    coarse = render(path, sampler, torch.rand(16))
    fine = sampler(path, coarse, example_draws())
    assert fine.s.shape == (len(path.s), 40)
    assert (fine.s.diff(dim=1) >= 0).all()
    assert ((fine.s[:, None] - coarse.samples.s[..., None]).abs().min(-1).values == 0).all()


def test_padding_reaches_bins_without_weight() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(16, 64, union=False, padding=0.1)
    coarse = render(path, sampler, spike(16, 9))
    bins = midpoints(coarse.samples.s)
    outside = (sampler(path, coarse).s < bins[:, 8:9]).sum(1)
    # 8 of the 14 bins lie before the spike's, each with 0.1 of a total of 1 + 14 * 0.1.
    assert (outside - 64 * 0.8 / 2.4).abs().max() <= 1.5


def test_blur_reaches_the_neighbours_of_a_spike() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(16, 400, union=False, blur=True)
    coarse = render(path, sampler, spike(16, 9))
    bins = midpoints(coarse.samples.s)
    fine = sampler(path, coarse).s
    shares = [((fine >= bins[:, i : i + 1]) & (fine < bins[:, i + 1 : i + 2])).float().mean() for i in (7, 8, 9)]
    torch.testing.assert_close(torch.stack(shares), torch.tensor([0.25, 0.5, 0.25]), atol=0.005, rtol=0)


def test_no_gradient_flows_through_where_samples_lie() -> None:
    path = example_path()
    sampler = Hierarchical(16, 24)
    weights = torch.rand(16, requires_grad=True)
    assert not sampler(path, render(path, sampler, weights)).s.requires_grad


def test_cones_are_redrawn_between_edges() -> None:
    path = straight_path(example_rays())
    sampler = Hierarchical(16, 24, union=False, cast="cones")
    coarse = render(path, sampler, spike(16, 5))
    fine = sampler(path, coarse, example_draws())
    assert fine.edges.shape == (len(path.s), 25)
    assert (fine.edges >= coarse.samples.edges[:, 5:6] - 1e-5).all()
    assert (fine.edges <= coarse.samples.edges[:, 6:7] + 1e-5).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_coarse": 3}, "num_coarse=3 is not allowed; take at least 4"),
        ({"num_fine": 0}, "num_fine=0 is not allowed; take at least 1"),
        ({"padding": -0.1}, "padding=-0.1 is not allowed; take at least 0"),
        ({"cast": "cones"}, "set union=false"),
    ],
)
def test_impossible_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(NerfroError, match=message):
        Hierarchical(**options)
