"""Sampling from a density grid: the compiled kernel against the reference implementation, and sample positions."""

from dataclasses import replace

import pytest
import torch

from nerfro.core.types import FieldValues, Path, Samples
from nerfro.fields.base import Field
from nerfro.geometry.space import Box, Contracted, Space, contracted_length
from nerfro.samplers.points.density_grid import DensityGridSampler
from nerfro.testing import example_draws, example_path

RADIUS = 0.4


class DenseBall(Field):
    """Density 50 inside a ball around the origin, nothing outside."""

    def forward(self, samples: Samples) -> FieldValues:
        inside = samples.positions.norm(dim=-1) < RADIUS
        return FieldValues(50.0 * inside, torch.zeros_like(samples.positions))


CUBE = Box([[-1.0] * 3, [1.0] * 3])
ALL_OF_SPACE = Contracted([[-1.0] * 3, [1.0] * 3], 0.7, near=0.3)


def trained_sampler(space: Space = CUBE) -> DensityGridSampler:
    sampler = DensityGridSampler(space, num_samples=16, num_bins=64, resolution=32, update_every=1)
    for step in range(200):
        sampler.update([DenseBall()], example_draws(step=step))
    return sampler


@pytest.mark.parametrize("space", [CUBE, ALL_OF_SPACE])
def test_compiled_sampler_matches_the_reference(space: Space) -> None:
    sampler, path = trained_sampler(space), example_path(64)
    for draws in (None, example_draws(64)):
        plain, compiled = sampler.draw(path, draws), sampler.draw_compiled(path, draws)
        # Nearly infinite places may differ by some of their distance.
        torch.testing.assert_close(compiled.edges, plain.edges, rtol=5e-3 * space.infinite, atol=2e-4)
        torch.testing.assert_close(compiled.s, plain.s, rtol=5e-3 * space.infinite, atol=2e-4)
        places = space.contract(compiled.positions), space.contract(plain.positions)
        torch.testing.assert_close(*places, rtol=0, atol=1e-3)
        torch.testing.assert_close(compiled.deltas, plain.deltas, rtol=1e-2, atol=2e-4)
        close = (compiled.directions - plain.directions).norm(dim=-1) < 1e-5
        assert close.float().mean() > 0.99  # a sample within rounding of a vertex may lie on either side


def test_samples_concentrate_at_the_density() -> None:
    sampler, path = trained_sampler(), example_path(64)
    samples = sampler(path, None)
    dense = (path.at(torch.linspace(2, 6, 400).expand(64, -1).contiguous())[0].norm(dim=-1) < RADIUS * 0.8).any(-1)
    assert 5 < dense.sum() < 60
    inside = (samples.positions.norm(dim=-1) < RADIUS * 1.2).float().mean(-1)
    assert inside[dense].mean() > 0.6


@pytest.mark.parametrize(("max_bin_alpha", "behind"), [(1.0, 0.0), (0.4, 0.26)])
def test_content_behind_a_partly_empty_cell_gets_samples(max_bin_alpha: float, behind: float) -> None:
    sampler = DensityGridSampler(CUBE, 64, 64, resolution=32, uniform=0.01, max_bin_alpha=max_bin_alpha)
    sampler.density[15:17] = 1e3  # four bins look opaque: two of a cell that something fills in part, and two behind
    path = straight(torch.tensor([0.0, 8.0]), 0.1)
    drawn = sampler(path, None)
    share = (drawn.positions[..., 0] > 0).float().mean()  # of the last two
    assert share == pytest.approx(behind, abs=0.05)


def straight(s: torch.Tensor, impact_parameter: float) -> Path:
    """One line along x past the origin, with vertices at arc lengths `s` from a camera at x = -4."""
    ones = torch.ones_like(s)
    positions = torch.stack([s - 4, impact_parameter * ones, 0 * ones], -1)[None]
    directions = torch.stack([ones, 0 * ones, 0 * ones], -1)[None]
    return Path.unbranched(positions, directions, s[None], torch.zeros(1).bool(), torch.zeros(1))


@pytest.mark.parametrize("impact_parameter", [0.0, 0.5, 2.0])
def test_samples_of_all_space_cover_the_contracted_length(impact_parameter: float) -> None:
    sampler = trained_sampler(ALL_OF_SPACE)
    path = straight(torch.tensor([2.0, 3.0, 3.5, 6.0]), impact_parameter)
    samples = sampler(path, None)
    shorter = ALL_OF_SPACE.scale(samples.positions)
    ends = contracted_length(torch.tensor([0.3 - 4, 1e6]), torch.tensor(impact_parameter), 0.7)
    torch.testing.assert_close((samples.deltas * shorter).sum(), ends[1] - ends[0], rtol=1e-3, atol=0)
    assert samples.edges[0, 0] == pytest.approx(0.3, abs=1e-3)  # though the path begins at 2
    assert samples.edges[0, -1] > 1e3  # though it ends at 6


def test_samples_of_all_space_do_not_depend_on_where_a_line_has_vertices() -> None:
    sampler = trained_sampler(ALL_OF_SPACE)
    few, many = (sampler(straight(s, 0.2), None) for s in (torch.tensor([1.0, 9.0]), torch.linspace(0.5, 7, 12)))
    places = ALL_OF_SPACE.contract(few.positions), ALL_OF_SPACE.contract(many.positions)
    torch.testing.assert_close(*places, rtol=0, atol=1e-5)
    torch.testing.assert_close(few.deltas[:, :-1], many.deltas[:, :-1], rtol=1e-3, atol=1e-5)


def test_evaluation_has_its_own_number_of_samples() -> None:
    sampler = DensityGridSampler(CUBE, num_samples=16, num_samples_evaluation=40)
    assert sampler(example_path(4), None, example_draws(4)).s.shape == (4, 16)
    assert sampler(example_path(4), None).s.shape == (4, 40)


def test_updated_grid_holds_the_density_of_the_field() -> None:
    sampler = trained_sampler()
    points = torch.rand(500, 3) * 2 - 1
    away = (points.norm(dim=-1) - RADIUS).abs() > 0.15
    remembered = sampler.lookup(points)[away]
    torch.testing.assert_close(remembered, DenseBall().density(points)[away])


class Fog(Field):
    """Density 1 everywhere."""

    def forward(self, samples: Samples) -> FieldValues:
        return FieldValues(torch.ones_like(samples.s), torch.zeros_like(samples.positions))


@pytest.mark.parametrize(("resolution", "fraction"), [(2, 1 / 16), (4, 1e-4)])
def test_small_updates_reach_all_cells(resolution: int, fraction: float) -> None:
    sampler = DensityGridSampler(CUBE, resolution=resolution, update_fraction=fraction, update_every=1)
    for step in range(12 * resolution**3):
        sampler.update([Fog()], example_draws(step=step))
    assert (sampler.density > 0).all()


def split_in_two(shares: tuple[float, float]) -> Path:
    """Each of 64 rays as two equal polylines with shares of its light."""
    path = example_path(64)
    rows = torch.arange(64).repeat_interleave(2)
    throughput = torch.tensor(shares).repeat(64)[:, None].expand(-1, 3)
    return replace(path[rows], splits=True, ray=rows, throughput=throughput)


def test_branches_are_sampled_by_their_weight_in_training() -> None:
    sampler, path = trained_sampler(), split_in_two((0.9, 0.1))
    samples = sampler(path, None, example_draws(64))
    num = (samples.deltas > 0).sum(-1).view(-1, 2)
    assert num.max(0).values.tolist() == [15, 8]
    dense = sampler.lookup(samples.positions) * samples.deltas >= 0.005
    main, faint = samples.occupied[::2], samples.occupied[1::2]
    assert torch.equal(main, samples.deltas[::2] > 0), "the main path finds what the grid has not seen yet"
    assert torch.equal(faint, dense[1::2])
    assert 0 < faint.sum() < main.sum() / 3
    # In pictures all are sampled alike.
    drawn = sampler(path, None)
    assert torch.equal(drawn.edges[::2], drawn.edges[1::2])


def test_main_polylines_are_sampled_like_unsplit_rays() -> None:
    sampler, path = trained_sampler(), example_path(64)
    alone = sampler(path, None, example_draws(64))
    whole = sampler(split_in_two((1.0, 1.0)), None, example_draws(64))
    assert torch.equal(whole.edges[::2], alone.edges)
    assert alone.occupied is None


@pytest.mark.parametrize("resolution", [8, 9])
def test_every_position_is_in_an_updated_cell(resolution: int) -> None:
    numbered = Contracted([[-1.0] * 3, [1.0] * 3], 1.0).cells(resolution)
    middle = (torch.arange(301) - 150) / 150.5  # of the cube around the ball; some lie in all cells that touch it
    places = torch.cartesian_prod(middle, middle, middle[::7])
    places = places[places.norm(dim=-1) < 1]
    cells = ((places + 1) / 2 * resolution).long()
    numbers = (cells[:, 0] * resolution + cells[:, 1]) * resolution + cells[:, 2]
    assert torch.isin(numbers.unique(), numbered).all()
    assert len(numbered) < resolution**3
