"""Sampling from a remembered density: the compiled kernel against its plain twin, and where samples go."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.samplers.density_grid import DensityGridSampler, field_density
from nerfro.samplers.stepfun import spread_uniform
from nerfro.testing import example_path
from nerfro.types import Radiance, Samples

RADIUS = 0.4


class DenseBall(Field):
    """Density 50 inside a ball around the origin, nothing outside."""

    def forward(self, samples: Samples) -> Radiance:
        inside = samples.positions.norm(dim=-1) < RADIUS
        return Radiance(50.0 * inside, torch.zeros_like(samples.positions))


def trained_sampler() -> DensityGridSampler:
    sampler = DensityGridSampler(num_samples=16, num_bins=64, resolution=32, every=1)
    for step in range(200):
        sampler.after_step(step, nn.ModuleList([DenseBall()]))
    return sampler


def test_compiled_kernel_draws_what_the_plain_twin_draws() -> None:
    sampler, path = trained_sampler(), example_path(64)
    for random in (False, True):
        u = spread_uniform(path, sampler.num_samples + 1, random)
        plain, compiled = sampler.draw(path, u), sampler.draw_compiled(path, u)
        torch.testing.assert_close(compiled.edges, plain.edges, rtol=0, atol=2e-4)
        torch.testing.assert_close(compiled.s, plain.s, rtol=0, atol=2e-4)
        torch.testing.assert_close(compiled.positions, plain.positions, rtol=0, atol=1e-3)
        close = (compiled.directions - plain.directions).norm(dim=-1) < 1e-5
        assert close.float().mean() > 0.99  # a sample within rounding of a vertex may lie on either side


@pytest.mark.parametrize("num_rows", [63, 65])
def test_kernel_refuses_other_numbers_of_rows_than_of_paths(num_rows: int) -> None:
    sampler, u = DensityGridSampler(num_samples=16), torch.zeros(num_rows, 17)
    with pytest.raises(NerfroError, match=f"{num_rows} rows .* 64 paths"):
        sampler.draw_compiled(example_path(64), u)


def test_samples_gather_where_the_density_is() -> None:
    sampler, path = trained_sampler().eval(), example_path(64)
    samples = sampler(path, None)
    dense = (path.at(torch.linspace(2, 6, 400).expand(64, -1).contiguous())[0].norm(dim=-1) < RADIUS * 0.8).any(-1)
    assert 5 < dense.sum() < 60
    inside = (samples.positions.norm(dim=-1) < RADIUS * 1.2).float().mean(-1)
    assert inside[dense].mean() > 0.6


def test_grid_remembers_the_field_it_looked_at() -> None:
    sampler = trained_sampler()
    points = torch.rand(500, 3) * 2 - 1
    away = (points.norm(dim=-1) - RADIUS).abs() > 0.15
    remembered = sampler.lookup(points)[away]
    torch.testing.assert_close(remembered, field_density(DenseBall(), points)[away])


def test_grid_travels_with_the_checkpoint() -> None:
    sampler = trained_sampler()
    restored = DensityGridSampler(num_samples=16, num_bins=64, resolution=32)
    restored.load_state_dict(sampler.state_dict())
    assert torch.equal(restored.density, sampler.density)
