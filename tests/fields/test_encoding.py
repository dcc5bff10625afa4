"""Encodings: of positions, and of conical frustums as Gaussians."""

import math

import pytest
import torch

from nerfro.core.types import Rays, Samples
from nerfro.paper.mlp import integrated_positional_encoding, positional_encoding
from nerfro.paper.nerf import frustum_gaussians
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import cone_samples
from nerfro.testing import example_path


def test_order_is_identity_then_all_sines_then_all_cosines_octave_by_octave() -> None:
    x = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    expected = x.tolist()
    for wave in (math.sin, math.cos):
        for octave in range(4):
            expected += [wave(2**octave * float(v)) for v in x]
    encoded = positional_encoding(x, 4)
    torch.testing.assert_close(encoded, torch.tensor(expected, dtype=torch.float64))


def test_integrated_encoding_is_the_mean_encoding_over_the_gaussian() -> None:
    num_draws = 200_000
    mean = torch.tensor([0.4, -0.2, 0.9], dtype=torch.float64)
    variance = torch.tensor([0.01, 0.2, 0.0], dtype=torch.float64)
    draws = mean + variance.sqrt() * torch.randn(num_draws, 3, dtype=torch.float64)
    monte_carlo = positional_encoding(draws, 6)[:, 3:].mean(0)
    integrated = integrated_positional_encoding(mean, variance, 6)
    # Each entry's standard deviation is at most 1; five standard errors.
    assert (integrated - monte_carlo).abs().max() < 5 / math.sqrt(num_draws)


def test_integrated_encoding_of_a_point_is_the_plain_one() -> None:
    x = torch.rand(7, 3, dtype=torch.float64)
    integrated = integrated_positional_encoding(x, torch.zeros_like(x), 8)
    torch.testing.assert_close(integrated, positional_encoding(x, 8)[:, 3:])


NUM_DRAWS = 400_000


def draw_from_frustum(near: float, far: float, radius: float) -> torch.Tensor:
    """Uniform points of a cone along z between two distances from its apex; radius is that at distance 1."""
    u = torch.rand(NUM_DRAWS, dtype=torch.float64)
    z = (near**3 + u * (far**3 - near**3)) ** (1 / 3)  # the cross-section grows with z^2
    angle = 2 * math.pi * torch.rand(NUM_DRAWS, dtype=torch.float64)
    across = radius * z * torch.rand(NUM_DRAWS, dtype=torch.float64).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), z], -1)


def one_frustum(near: float, far: float, radius: float) -> Samples:
    edges = torch.tensor([[near, far]], dtype=torch.float64)
    zero, along = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    rays = Rays(zero, along, torch.full((1,), radius, dtype=torch.float64), edges[:, 0], edges[:, 1])
    return cone_samples(straight_path(rays), edges)


@pytest.mark.parametrize(("near", "far", "radius"), [(2.0, 6.0, 0.3), (1.0, 1.2, 0.05), (0.01, 3.0, 1.0)])
def test_moments_match_points_in_the_frustum(near: float, far: float, radius: float) -> None:
    mean, variance = frustum_gaussians(one_frustum(near, far, radius))
    points = draw_from_frustum(near, far, radius)
    deviation = points.std(0)
    assert ((mean[0, 0] - points.mean(0)).abs() < 5 * deviation / math.sqrt(NUM_DRAWS)).all()
    # The variance of a sample variance is below that of a bounded variable's square: relative error ~ sqrt(2 / N).
    relative = (variance[0, 0] - points.var(0)).abs() / points.var(0)
    assert (relative < 5 * math.sqrt(2 / NUM_DRAWS)).all()


def test_covariance_rotates_with_the_direction() -> None:
    samples = one_frustum(2.0, 3.0, 0.2)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    turned = Samples(samples.s[..., None] * axis, axis.expand(1, 1, 3), samples.s, samples.edges, samples.radii)
    _, straight = frustum_gaussians(samples)
    _, variance = frustum_gaussians(turned)
    across, along = straight[0, 0, 0], straight[0, 0, 2]
    outer = torch.outer(axis, axis)
    covariance = along * outer + across * (torch.eye(3, dtype=torch.float64) - outer)
    torch.testing.assert_close(variance[0, 0], covariance.diagonal())


def test_thin_frustum_in_single_precision_keeps_a_positive_variance() -> None:
    samples = one_frustum(4.0, 4.0 + 1e-4, 1e-3)
    single = Samples(*(getattr(samples, n).float() for n in ("positions", "directions", "s", "edges", "radii")))
    _, variance = frustum_gaussians(single)
    _, exact = frustum_gaussians(samples)
    assert (variance > 0).all()
    torch.testing.assert_close(variance, exact.float(), rtol=0.05, atol=0)


def test_mean_lies_on_the_bent_path_beyond_the_middle_of_its_interval() -> None:
    path = example_path()
    edges = path.near[:, None] + torch.linspace(0, 1, 33) * (path.far - path.near)[:, None]
    samples = cone_samples(path, edges)
    mean, _ = frustum_gaussians(samples)
    ahead = ((mean - samples.positions) * samples.directions).sum(-1)
    assert (ahead > 0).all(), "the far half of a cone holds more of its volume"
    assert (ahead < 0.5 * samples.deltas).all()
