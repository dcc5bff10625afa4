"""Losses and the schedule of their weights: manual values, and the parameters with gradients."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.light import ColourSpace, to_srgb
from nerfro.core.types import Batch, Path, Rendering, Samples
from nerfro.losses.terms import (
    BackgroundRegularizer,
    Distortion,
    Photometric,
    TotalVariation,
    direction_pairs,
    distortion,
)
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.losses import Smoothness, tile_roughness
from nerfro.registry.registration import create, discover, find
from nerfro.rendering import Renderer, Scene
from nerfro.samplers.points.stratified import point_samples
from nerfro.testing import NUM_RAYS, example_batch, example_components, example_draws, example_path, example_rendering
from tests.paper import small_components


@pytest.fixture(scope="module")
def model() -> Renderer:
    return RefractiveModel(small_components(), colour="srgb")


def gradient_norms(model: Renderer, value: Tensor) -> dict[str, float]:
    model.zero_grad()
    value.backward()
    parts = {"coarse": model.scene.fields[0], "fine": model.scene.fields[1], "background": model.scene.background}
    return {
        name: sum(float(p.grad.abs().sum()) for p in part.parameters() if p.grad is not None)
        for name, part in parts.items()
    }


def test_photometric_loss_is_the_mean_over_rays_and_channels_of_both_levels(model: Renderer) -> None:
    batch = example_batch()
    coarse = replace(example_rendering(), radiance=batch.rgb + 0.1)
    fine = replace(coarse, radiance=batch.rgb - 0.3)
    torch.testing.assert_close(Photometric()([coarse, fine], batch, model.scene), torch.tensor(0.09 + 0.01))
    torch.testing.assert_close(Photometric(coarse=0.1)([coarse, fine], batch, model.scene), torch.tensor(0.09 + 0.001))


def test_photometric_loss_reaches_both_fields_and_the_background(model: Renderer) -> None:
    batch = example_batch()
    norms = gradient_norms(model, Photometric()(model(batch.rays), batch, model.scene))
    assert min(norms.values()) > 0


def test_background_regularizer_can_be_restricted_to_refracted_rays(model: Renderer) -> None:
    batch = example_batch()
    rendering = replace(example_rendering(), transmittance=torch.ones(NUM_RAYS))
    refracted = rendering.path.refracted
    assert 0 < refracted.sum() < NUM_RAYS
    error = (rendering.background_radiance - batch.rgb).abs().sum(-1)[refracted]
    value = BackgroundRegularizer(refracted_only=True)([rendering], batch, model.scene)
    torch.testing.assert_close(value, error.sum() / (len(error) + 1))


def test_background_regularizer_has_gradients_only_for_the_fine_density(model: Renderer) -> None:
    with torch.no_grad():
        for field in model.scene.fields:
            field.mlp.density.bias.fill_(-3.0)  # thin enough for light to pass
    batch = example_batch()
    renderings = model(batch.rays)
    assert (renderings[-1].transmittance > 0.5).any()
    norms = gradient_norms(model, BackgroundRegularizer(refracted_only=False)(renderings, batch, model.scene))
    assert norms["coarse"] == norms["background"] == 0
    assert norms["fine"] > 0
    colour = model.scene.fields[1].mlp.rgb
    assert colour.weight.grad is None or (colour.weight.grad == 0).all()


def test_roughness_is_half_the_mean_square_of_two_convolutions() -> None:
    rgb = torch.rand(9, 7, 3)
    channels = rgb.movedim(-1, 0)[:, None]
    horizontal = conv2d(channels, torch.tensor([[[[-1.0, 1.0]]]]))
    vertical = conv2d(channels, torch.tensor([[[[-1.0], [1.0]]]]))
    expected = 0.5 * horizontal.square().mean() + 0.5 * vertical.square().mean()
    torch.testing.assert_close(tile_roughness(rgb), expected)


def test_smoothness_has_gradients_only_for_the_background(model: Renderer) -> None:
    batch = example_batch()
    norms = gradient_norms(model, Smoothness(tile_size=8)(model(batch.rays), batch, model.scene))
    assert norms["coarse"] == norms["fine"] == 0
    assert norms["background"] > 0


def test_weight_is_zero_before_the_start_then_grows_linearly_to_its_value() -> None:
    loss = create(find("loss", "photometric"), {"weight": 2.0, "start": 10, "ramp": 4})
    assert [loss.weight_at(step) for step in (0, 9)] == [0, 0]
    torch.testing.assert_close(
        torch.tensor([loss.weight_at(step) for step in range(10, 16)]), torch.tensor([0.4, 0.8, 1.2, 1.6, 2.0, 2.0])
    )


BATCH = example_batch()


def test_pairs_are_uniform_and_separated_by_the_angle() -> None:
    first, second = direction_pairs(torch.rand(20_000, 3), 0.3)
    for directions in (first, second):
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(20_000))
        # A uniform direction has mean 0 and covariance 1/3; the means scatter by 0.004.
        assert directions.mean(0).abs().max() < 0.02
        torch.testing.assert_close(directions.T @ directions / 20_000, torch.eye(3) / 3, rtol=0, atol=0.02)
    torch.testing.assert_close((first * second).sum(-1), torch.full((20_000,), math.cos(0.3)), rtol=0, atol=1e-5)


def scene(background) -> Mock:
    return Mock(spec=Scene, background=background, colour_space=ColourSpace.SRGB)


def test_value_is_that_of_a_linear_sky() -> None:
    # For C = d . a the mean of |C(d') - C(d)| is angle |a| / 2, the mean of |cos| over the sphere, to second order.
    sky = scene(lambda exits: (exits.directions * 0.8).sum(-1, keepdim=True).expand(-1, 3) * 0.5 / math.sqrt(3))
    loss = TotalVariation(angle=1.0)
    values = [float(loss([], replace(BATCH, draws=example_draws(step=step)), sky)) for step in range(30)]
    # The mean over 30 steps of 1024 pairs scatters by 0.3 %.
    assert sum(values) / len(values) == pytest.approx(math.radians(1.0) * 0.4 / 2, rel=0.02)


# Rays of three pixels: one through the first, three through the second, four through the last.
PIXEL = torch.tensor([0, 1, 2, 2, 1, 2, 1, 2])
MODEL = RefractiveModel(example_components())


def rendering(colour: Tensor, background: Tensor, passed: Tensor) -> Rendering:
    path = example_path(8)
    samples = point_samples(path, path.near[:, None])
    radiance = (1 - passed)[:, None] * colour + passed[:, None] * background
    return Rendering(radiance, (1 - passed)[:, None], passed, background, samples, path)


def batch() -> Batch:
    """Three pixels of any colour."""
    rows = torch.arange(3)
    return replace(
        example_batch(8),
        maps={},
        ray_pixel=PIXEL,
        pixel_number=rows,
        view=0 * rows,
        rgb=torch.rand(3, 3),
        teaches_background=rows >= 0,
    )


def test_values_of_a_pixel_are_the_mean_over_its_rays_in_any_order() -> None:
    for values in (torch.rand(8), torch.rand(8, 3)):
        expected = torch.stack([values[pixel == PIXEL].mean(0) for pixel in range(3)])
        torch.testing.assert_close(batch().per_pixel(values), expected)
        assert example_batch(8).per_pixel(values) is values


def test_losses_compare_pixels_and_not_their_rays() -> None:
    given, rendered = batch(), rendering(torch.rand(8, 3), torch.rand(8, 3), torch.rand(8))
    expected = (to_srgb(given.per_pixel(rendered.radiance)) - given.rgb).square().mean()
    torch.testing.assert_close(Photometric()([rendered], given, MODEL.scene), expected)


def test_background_regularizer_uses_the_background_of_pixels() -> None:
    given, passed = batch(), torch.tensor([0.9, 0.9, 0.2, 0.2, 0.9, 0.2, 0.9, 0.2])  # of the last pixel little
    rendered = rendering(torch.rand(8, 3), torch.rand(8, 3), passed)
    background = to_srgb(given.per_pixel(passed[:, None] * rendered.background_radiance))
    expected = (background - given.rgb).abs().sum(-1)[:2].sum() / (2 + 1)
    torch.testing.assert_close(BackgroundRegularizer(refracted_only=False)([rendered], given, MODEL.scene), expected)


def test_background_regularizer_adds_no_density_in_front_of_overexposed_pixels() -> None:
    passed = torch.full((8,), 0.9, requires_grad=True)
    rendered = replace(rendering(torch.rand(8, 3), torch.full((8, 3), 2.0), passed), transmittance=passed)
    given = replace(batch(), rgb=torch.ones(3, 3))
    value = BackgroundRegularizer(refracted_only=False)([rendered], given, MODEL.scene)
    assert value.item() == 0
    assert not torch.autograd.grad(value, passed)[0].any()


def test_absorption_replaces_dark_fog_that_explains_the_photograph() -> None:
    """Fog that takes a fifth of the light has no photometric error; the regularizer increases the absorption."""
    absorption = torch.tensor([[0.0] * 3, [0.1, 0.2, 0.3]], requires_grad=True)
    path = example_path(8)
    path = replace(path, record=replace(path.record, absorption=absorption))
    passed = torch.full((8,), 0.8, requires_grad=True)
    light = torch.full((8, 3), 0.5) * path.whole_transmittance()
    fog = replace(rendering(torch.rand(8, 3), light, passed), transmittance=passed, path=path)
    fog = replace(fog, radiance=passed[:, None] * light)
    given = replace(example_batch(8), maps={}, rgb=to_srgb(fog.radiance.detach()))
    exact = Photometric()([fog], given, MODEL.scene)
    regularizer = BackgroundRegularizer(refracted_only=False)([fog], given, MODEL.scene)
    assert exact.item() == pytest.approx(0, abs=1e-12)
    assert (torch.autograd.grad(regularizer, absorption)[0][1] < 0).all()


def test_gradient_of_a_body_that_absorbs_all_light_is_finite() -> None:
    absorption = torch.tensor([[0.0] * 3, [1e4] * 3], requires_grad=True)
    path = example_path(8)
    path = replace(path, record=replace(path.record, absorption=absorption))
    dark = path.whole_transmittance()
    assert (dark == 0).any()
    black = replace(rendering(torch.zeros(8, 3), dark, torch.ones(8)), transmittance=torch.ones(8), path=path)
    given = replace(example_batch(8), maps={}, rgb=torch.rand(8, 3))
    regularizer = BackgroundRegularizer(refracted_only=False)([black], given, MODEL.scene)
    assert torch.autograd.grad(regularizer, absorption)[0].isfinite().all()


@pytest.mark.parametrize("absorbs", [False, True])
def test_background_learns_from_selected_rays_and_the_medium_from_all(absorbs: bool) -> None:
    sky = EnvironmentMap([4])
    torch.nn.init.normal_(sky.texels)
    model = RefractiveModel(replace(example_components(), background=sky))
    directions = torch.nn.functional.normalize(torch.randn(8, 3), dim=-1).requires_grad_()
    absorption = torch.tensor([[0.0] * 3, [0.1, 0.2, 0.3]], requires_grad=True)
    path = example_path(8)
    path = replace(path, directions=torch.cat([path.directions[:, :-1], directions[:, None]], 1))
    path = replace(path, record=replace(path.record, absorption=absorption)) if absorbs else path
    teaches = PIXEL != 1

    def gradients(held: Tensor) -> list[Tensor]:
        """By the sky and by what bends and tints the rays; by the rays in a sum of two renderings."""
        weights = torch.linspace(0.5, 1.5, 8)[:, None]
        seen = model.render_path(path, replace(example_batch(8), teaches_background=held))[-1].radiance
        learned = [sky.texels, directions, *([absorption] if absorbs else [])]
        return list(torch.autograd.grad((weights * seen.square()).sum(), learned))

    every, none = torch.ones(8, dtype=torch.bool), torch.zeros(8, dtype=torch.bool)
    of_all, of_some = gradients(every), gradients(teaches)
    for whole, part in zip(of_all[1:], of_some[1:], strict=True):
        torch.testing.assert_close(part, whole)
    torch.testing.assert_close(of_some[0] + gradients(~teaches)[0], of_all[0])
    assert of_some[0].abs().max() > 0
    assert gradients(none)[0].abs().max() == 0


def test_saturated_pixel_has_no_error_if_both_clip_and_a_gradient_if_one_does() -> None:
    photograph = torch.tensor([1.0, 1.0, 0.6])  # saturated, saturated, not
    radiance = torch.tensor([3.0, 0.5, 3.0], requires_grad=True)
    prediction, target = MODEL.scene.colour_space.prediction_and_target(radiance, photograph)
    (prediction - target).square().sum().backward()
    lamp, too_dark, too_bright = radiance.grad
    assert lamp == 0
    assert too_dark < 0 < too_bright


def test_authors_colour_space_neither_encodes_nor_clips() -> None:
    model = RefractiveModel(example_components(), colour="srgb")
    radiance, photograph = 1.2 * torch.rand(50, 3), torch.rand(50, 3).round()
    prediction, target = model.scene.colour_space.prediction_and_target(radiance, photograph)
    assert prediction is radiance
    assert target is photograph


discover()

SCENE = Mock(spec=Scene)


def random_intervals(num_rays: int, num_samples: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(num_rays, num_samples, generator=generator, dtype=dtype) ** 4
    edges = torch.rand(num_rays, num_samples + 1, generator=generator, dtype=dtype).cumsum(-1)
    return weights / weights.sum(-1, keepdim=True), edges / edges[:, -1:]


def double_loop(weights: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """Eqn. 15 of mip-NeRF 360 as it is written."""
    total = weights.new_zeros(len(weights))
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    for i in range(weights.shape[1]):
        for j in range(weights.shape[1]):
            total = total + weights[:, i] * weights[:, j] * (middle[:, i] - middle[:, j]).abs()
        total = total + weights[:, i] ** 2 * (edges[:, i + 1] - edges[:, i]) / 3
    return total


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_prefix_sums_equal_the_double_loop(dtype: torch.dtype, tolerance: float) -> None:
    weights, edges = random_intervals(7, 13, dtype)
    ours, reference = weights.clone().requires_grad_(), weights.clone().requires_grad_()
    value, expected = distortion(ours, edges), double_loop(reference, edges)
    torch.testing.assert_close(value, expected, rtol=tolerance, atol=0)
    value.sum().backward()
    expected.sum().backward()
    torch.testing.assert_close(ours.grad, reference.grad, rtol=tolerance, atol=tolerance)


def loss(weights: torch.Tensor, s: torch.Tensor, contracted_edges: torch.Tensor | None = None) -> torch.Tensor:
    """Of weights on intervals between arc lengths [5, 7], which may have other lengths in contracted space."""
    ends = s[:, [0, -1]]
    vectors = torch.zeros(5, 2, 3)
    path = Path.unbranched(vectors, vectors, ends, torch.zeros(5, dtype=torch.bool), torch.ones(5))
    positions = torch.zeros(5, 6, 3)
    samples = Samples(positions, positions, s[:, :-1], s, torch.ones(5), contracted_edges=contracted_edges)
    colour = torch.zeros(5, 3)
    rendering = Rendering(colour, weights, 1 - weights.sum(-1), colour, samples, path)
    return Distortion()([rendering], example_batch(len(colour)), SCENE)


def test_loss_is_invariant_to_scale_and_translation() -> None:
    weights, edges = random_intervals(5, 6, torch.float32)
    torch.testing.assert_close(loss(weights, edges), loss(weights, 2.0 + 30.0 * edges), rtol=1e-4, atol=0)


def test_distances_are_contracted_with_space() -> None:
    weights, edges = random_intervals(5, 6, torch.float32)
    edges[:, 0] = 0.0
    far_away = torch.tan(edges * 1.57)  # however long the last interval is
    weights = weights / weights.sum(-1, keepdim=True)  # nothing passes
    contracted = loss(weights, far_away, contracted_edges=3.0 * edges)
    torch.testing.assert_close(contracted, loss(weights, edges), rtol=1e-4, atol=0)


def test_transmitted_light_counts_at_infinity_in_all_space() -> None:
    edges = torch.linspace(0, 1, 7).expand(5, -1)
    half = torch.tensor([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]).expand(5, -1)
    # 2 x 1/2 x 1/2 x 3/4 between the two, and 1/3 x 1/4 x 1/6 within the first.
    assert float(loss(half, edges, contracted_edges=edges)) == pytest.approx(0.375 + 1 / 72, rel=1e-4)
    assert float(loss(half, edges)) == pytest.approx(1 / 72, rel=1e-4)  # a sky stands beyond the path
    assert float(loss(0 * half, edges, contracted_edges=edges)) == pytest.approx(0, abs=1e-6)
