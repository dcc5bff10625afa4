"""Volume rendering against a slow loop and a closed form, and paths as polylines."""

import math

import pytest
import torch

from nerfro.core.compositing import composite, volume_weights
from nerfro.core.types import FieldValues, Path, Samples
from nerfro.samplers.base import straight_path
from nerfro.samplers.points.stratified import Stratified
from nerfro.testing import NUM_RAYS, example_path, example_rays, example_samples
from tests.closed_forms import Ball, beam
from tests.reference_tracer import Snell


def smooth_radiance(samples: Samples) -> FieldValues:
    """Density and colour as smooth functions of position and direction."""
    density = 3 * torch.exp(-samples.positions.square().sum(-1))
    return FieldValues(density, torch.sigmoid(samples.positions + samples.directions))


@pytest.mark.parametrize("density", [0.0, 1e-8, 1e8])
def test_extreme_densities_stay_finite_and_have_finite_gradients(density: float) -> None:
    raw = torch.full((2, 8), density, requires_grad=True)
    weights, transmittance = volume_weights(raw, torch.ones(2, 8))
    torch.testing.assert_close(weights.sum(-1) + transmittance, torch.ones(2))
    (weights[:, 0].sum() + transmittance.sum()).backward()
    assert raw.grad is not None
    assert raw.grad.isfinite().all()


def test_dense_ball_of_glass_absorbs_along_its_chords() -> None:
    # Beer-Lambert along a refracted ray: exp(-a l) with the chord l = 2 R cos t, sin t = b / (n R).
    radius, n, absorption = 0.8, 1.5, 1.7
    heights = torch.linspace(-0.75, 0.75, 11, dtype=torch.float64)
    path = Snell()(beam(heights, far=6.0), Ball(radius, n).double())
    samples = Stratified(8192).eval()(path, None)
    density = torch.where(samples.positions.norm(dim=-1) < radius, absorption, 0.0)
    _, transmittance = volume_weights(density, samples.deltas)
    chord = 2 * radius * (1 - (heights / (n * radius)) ** 2).sqrt()
    # The surface lies within a sample's interval at either end.
    step = float(samples.deltas[:, 0].max())
    torch.testing.assert_close(transmittance, torch.exp(-absorption * chord), atol=absorption * step, rtol=0)


def test_compositing_equals_a_slow_loop() -> None:
    samples, background = example_samples(), torch.rand(NUM_RAYS, 3)
    values = smooth_radiance(samples)
    rendering = composite(samples, values, background, example_path())
    for ray in range(NUM_RAYS):
        colour, transmittance = torch.zeros(3), 1.0
        for i in range(samples.s.shape[1]):
            alpha = 1 - math.exp(-float(values.density[ray, i] * samples.deltas[ray, i]))
            colour += transmittance * alpha * values.radiance[ray, i]
            transmittance *= 1 - alpha
        colour += transmittance * background[ray]
        torch.testing.assert_close(rendering.radiance[ray], colour, atol=1e-5, rtol=0)
        assert rendering.transmittance[ray] == pytest.approx(transmittance, abs=1e-5)


def test_opaque_wall_hides_the_background_and_gives_its_depth() -> None:
    samples = example_samples()
    density = torch.where(torch.arange(16) == 5, 1e6, 0.0).expand_as(samples.s)
    radiance = torch.full_like(samples.positions, 0.25)
    rendering = composite(samples, FieldValues(density, radiance), torch.ones(NUM_RAYS, 3), example_path())
    torch.testing.assert_close(rendering.radiance, torch.full((NUM_RAYS, 3), 0.25))
    assert (rendering.depth >= samples.edges[:, 5]).all()
    assert (rendering.depth <= samples.edges[:, 6]).all()


def test_half_precision_radiance_is_summed_in_single_precision() -> None:
    samples = example_samples()
    values = smooth_radiance(samples)
    half = FieldValues(values.density.bfloat16(), values.radiance.bfloat16())
    assert composite(samples, half, torch.zeros(NUM_RAYS, 3).bfloat16(), example_path()).radiance.dtype == torch.float32


def test_rendering_converges_with_the_number_of_samples() -> None:
    path = straight_path(example_rays())

    def transmittance(num_samples: int) -> torch.Tensor:
        samples = Stratified(num_samples).eval()(path, None)
        return composite(samples, smooth_radiance(samples), torch.zeros(NUM_RAYS, 3), path).transmittance.double()

    exact = transmittance(8192)
    errors = [float((transmittance(n) - exact).abs().max()) for n in (32, 128)]
    # A sample stands for the interval after it: a first-order rule, four times the samples a quarter of the error.
    assert 3 < errors[0] / errors[1] < 6


def corner() -> Path:
    """A path of three vertices with a right angle: along x for 2, then along y for 3."""
    positions = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [2, 3, 0]]])
    directions = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 1, 0]]])
    s = torch.tensor([[1.0, 3, 6]])
    return Path.unbranched(positions, directions, s, torch.tensor([True]), torch.tensor([0.01]))


def test_point_of_a_bent_path_follows_the_nearest_former_vertex() -> None:
    positions, directions = corner().at(torch.tensor([[1.0, 2.5, 3.0, 3.5, 6.0]]))
    expected = torch.tensor([[[0.0, 0, 0], [1.5, 0, 0], [2, 0, 0], [2, 0.5, 0], [2, 3, 0]]])
    torch.testing.assert_close(positions, expected)
    # At a vertex (s = 3) the direction is still that of the segment that led there.
    assert directions[0, :, 0].tolist() == [1, 1, 1, 0, 0]


def test_point_before_near_or_beyond_far_goes_straight_on() -> None:
    positions, _ = corner().at(torch.tensor([[0.5, 7.0]]))
    torch.testing.assert_close(positions, torch.tensor([[[-0.5, 0.0, 0.0], [2, 4, 0]]]))
