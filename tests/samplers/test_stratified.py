"""Coarse samples: one in each bin, on straight and on bent paths."""

import math

import pytest
import torch

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path
from nerfro.paper.eikonal import Eikonal
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import LAST_FRACTION, Stratified
from nerfro.testing import example_draws, example_rays
from tests.closed_forms import Luneburg

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
    with pytest.raises(NerfroError, match=r"multiple of 7 path vertices, this path has 48"):
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
