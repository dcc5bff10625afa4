"""The networks: published sizes, activations and skip connections; encodings of positions and of conical frustums."""

import math

import pytest
import torch

from nerfro.core.light import to_srgb
from nerfro.core.types import Rays, Samples
from nerfro.fields.base import radiance
from nerfro.geometry.space import Box, inside_box
from nerfro.paper.mlp import (
    RGB_PADDING,
    RadianceMLP,
    SkipMLP,
    integrated_positional_encoding,
    padded_sigmoid,
    positional_encoding,
)
from nerfro.paper.nerf import MipNerfField, NerfField, frustum_gaussians
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import Stratified, cone_samples
from nerfro.testing import example_path
from tests.gradients import require_equal_gradients


def test_forward_equals_a_slow_loop_over_layers() -> None:
    mlp = SkipMLP(num_inputs=5, width=8, depth=4, skip=2)
    x = torch.randn(11, 5)
    y = x
    for i in range(4):
        layer = mlp.layers[i]
        y = (y @ layer.weight.T + layer.bias).clamp(min=0)
        if i == 1:
            y = torch.cat([y, x], -1)
    torch.testing.assert_close(mlp(x), y)


def test_bottleneck_and_view_layer_equal_two_layers_with_their_gradients() -> None:
    mlp = RadianceMLP(6, 5, width=8, depth=2, skip=1, view_width=4)
    torch.nn.init.normal_(mlp.bottleneck.bias)
    position, direction = torch.randn(9, 6), torch.randn(9, 5)
    features = mlp.trunk(position)
    two_layers = mlp.view(torch.cat([mlp.bottleneck(features), direction], -1)).clamp(min=0)
    colours = mlp(position, direction)[1], padded_sigmoid(mlp.rgb(two_layers))
    torch.testing.assert_close(*colours)
    layers = [*mlp.trunk.parameters(), *mlp.bottleneck.parameters(), *mlp.view.parameters()]
    require_equal_gradients(*colours, layers, atol=1e-5)


def test_published_nerf_has_its_number_of_weights() -> None:
    def linear(num_inputs: int, num_outputs: int) -> int:
        return (num_inputs + 1) * num_outputs

    expected = linear(63, 256) + 6 * linear(256, 256) + linear(256 + 63, 256)  # trunk
    expected += linear(256, 1) + linear(256, 256) + linear(256 + 27, 128) + linear(128, 3)
    assert sum(p.numel() for p in NerfField().parameters()) == expected


def test_density_is_a_shifted_softplus() -> None:
    mlp = RadianceMLP(6, 6, width=8, depth=2, skip=1, view_width=4)
    torch.nn.init.zeros_(mlp.density.weight)
    density, _ = mlp(torch.randn(9, 6), torch.randn(9, 6))
    torch.testing.assert_close(density, torch.full((9,), math.log1p(math.exp(-1.0))))


def test_density_does_not_depend_on_the_direction_but_colour_does() -> None:
    mlp = RadianceMLP(6, 6, width=32, depth=2, skip=1, view_width=16)
    position = torch.randn(9, 6)
    (density, rgb), (same, other) = (mlp(position, torch.randn(9, 6)) for _ in range(2))
    assert torch.equal(density, same)
    assert not torch.allclose(rgb, other)


def test_colour_reaches_a_thousandth_beyond_black_and_white() -> None:
    ends = padded_sigmoid(torch.tensor([-100.0, 0.0, 100.0]))
    torch.testing.assert_close(ends, torch.tensor([-RGB_PADDING, 0.5, 1 + RGB_PADDING]))


def test_mip_nerf_field_depends_on_the_cone_size() -> None:
    field = MipNerfField(width=16, depth=2, skip=1, view_width=8)
    samples = Stratified(8, cast="cones").eval()(example_path(), None)
    wider = type(samples)(samples.positions, samples.directions, samples.s, samples.edges, 100 * samples.radii)
    assert not torch.allclose(field(samples).density, field(wider).density)


def test_points_evaluated_in_blocks_equal_points_evaluated_together_with_their_gradients() -> None:
    field = NerfField(width=8, depth=2, skip=1, view_width=4)
    positions, directions = torch.randn(3, 1700, 3), torch.randn(3, 1700, 3)  # the last of two blocks is smaller
    whole = field.decode(positions, directions)
    density, rgb = (torch.stack(each) for each in zip(*map(field.decode, positions, directions), strict=True))
    torch.testing.assert_close(whole, (density, rgb))
    require_equal_gradients(whole[1], rgb, [*field.mlp.trunk.parameters()], atol=1e-5)


@pytest.mark.parametrize("make", [NerfField, MipNerfField])
def test_field_with_a_box_equals_one_without_inside_and_is_empty_outside(make: type[NerfField | MipNerfField]) -> None:
    everywhere = make(width=16, depth=2, skip=1, view_width=8)
    inside = make(width=16, depth=2, skip=1, view_width=8, space=Box([[-0.4, -0.5, -0.6], [0.6, 0.5, 0.4]]))
    inside.load_state_dict(everywhere.state_dict())
    samples = Stratified(32, cast="cones")(example_path(8), None)
    kept = inside_box(samples.positions, *inside.bounds)
    assert 0 < kept.sum() < kept.numel()
    expected, values = everywhere(samples), inside(samples)
    torch.testing.assert_close(values.density, expected.density * kept)
    torch.testing.assert_close(values.radiance, expected.radiance * kept[..., None])
    assert everywhere.bounds is None


def test_saturated_radiance_has_only_a_brightening_gradient() -> None:
    raw = torch.tensor([-50.0, -50.0, 0.3], requires_grad=True)
    (gradient,) = torch.autograd.grad((radiance(raw) * torch.tensor([-1.0, 1.0, 1.0])).sum(), raw)
    brighter, darker, ordinary = gradient
    assert brighter < 0
    assert darker == 0
    sigma = torch.sigmoid(torch.tensor(0.3))
    torch.testing.assert_close(ordinary, 2 * sigma.square() * (1 - sigma))
    assert to_srgb(radiance(raw))[0] * 255 < 1.1


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
