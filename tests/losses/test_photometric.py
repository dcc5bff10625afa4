"""The re-rendering error of pixels that have one ray or several, and what learns from it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.light import to_srgb
from nerfro.losses.boundary import BoundaryRegulariser
from nerfro.losses.photometric import Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.samplers.stratified import point_samples
from nerfro.testing import example_batch, example_components, example_path
from nerfro.types import Batch, Rendering

# Rays of three pixels: one through the first, three through the second, four through the last.
PIXEL = torch.tensor([0, 1, 2, 2, 1, 2, 1, 2])
MODEL = RefractiveModel(example_components())


def rendering(colour: Tensor, background: Tensor, passed: Tensor) -> Rendering:
    path = example_path(8)
    samples = point_samples(path, path.near[:, None])
    rgb = (1 - passed)[:, None] * colour + passed[:, None] * background
    return Rendering(rgb, (1 - passed)[:, None], passed, background, samples, path)


def batch() -> Batch:
    """Three pixels of any colour."""
    rows = torch.arange(3)
    return replace(
        example_batch(8), pixel=PIXEL, index=rows, view=0 * rows, rgb=torch.rand(3, 3), teaches_background=rows >= 0
    )


def test_values_of_a_pixel_are_the_mean_over_its_rays_in_any_order() -> None:
    for values in (torch.rand(8), torch.rand(8, 3)):
        expected = torch.stack([values[pixel == PIXEL].mean(0) for pixel in range(3)])
        torch.testing.assert_close(batch().per_pixel(values), expected)
        assert example_batch(8).per_pixel(values) is values


def test_pixels_are_compared_and_not_their_rays() -> None:
    given, rendered = batch(), rendering(torch.rand(8, 3), torch.rand(8, 3), torch.rand(8))
    expected = (to_srgb(given.per_pixel(rendered.rgb)) - given.rgb).square().mean()
    torch.testing.assert_close(Photometric()([rendered], given, MODEL.scene), expected)


def test_the_regulariser_compares_the_background_of_a_pixel_as_well() -> None:
    given, passed = batch(), torch.tensor([0.9, 0.9, 0.2, 0.2, 0.9, 0.2, 0.9, 0.2])  # of the last pixel little
    rendered = rendering(torch.rand(8, 3), torch.rand(8, 3), passed)
    background = to_srgb(given.per_pixel(passed[:, None] * rendered.boundary_rgb))
    expected = (background - given.rgb).abs().sum(-1)[:2].sum() / (2 + 1)
    torch.testing.assert_close(BoundaryRegulariser()([rendered], given, MODEL.scene), expected)


@pytest.mark.parametrize("absorbs", [False, True])
def test_a_background_learns_from_chosen_rays_and_what_bends_them_from_all(absorbs: bool) -> None:
    sky = EnvironmentMap([4])
    torch.nn.init.normal_(sky.texels)
    model = RefractiveModel(replace(example_components(), boundary=sky))
    directions = torch.nn.functional.normalize(torch.randn(8, 3), dim=-1).requires_grad_()
    absorption = torch.tensor([[0.0] * 3, [0.1, 0.2, 0.3]], requires_grad=True)
    path = example_path(8)
    path = replace(path, directions=torch.cat([path.directions[:, :-1], directions[:, None]], 1))
    path = replace(path, absorption=absorption) if absorbs else path
    teaches = PIXEL != 1

    def gradients(held: Tensor) -> list[Tensor]:
        """By the sky and by what bends and tints the rays; by the rays in a sum of two renderings."""
        weights = torch.linspace(0.5, 1.5, 8)[:, None]
        seen = model.render_path(path, None, held)[-1].rgb
        learned = [sky.texels, directions, *([absorption] if absorbs else [])]
        return list(torch.autograd.grad((weights * seen.square()).sum(), learned))

    every, none = torch.ones(8, dtype=torch.bool), torch.zeros(8, dtype=torch.bool)
    of_all, of_some = gradients(every), gradients(teaches)
    for whole, part in zip(of_all[1:], of_some[1:], strict=True):
        torch.testing.assert_close(part, whole)
    torch.testing.assert_close(of_some[0] + gradients(~teaches)[0], of_all[0])
    assert of_some[0].abs().max() > 0
    assert gradients(none)[0].abs().max() == 0


def test_a_saturated_pixel_is_no_error_where_both_clip_and_keeps_a_gradient_where_one_does() -> None:
    photograph = torch.tensor([1.0, 1.0, 0.6])  # saturated, saturated, not
    radiance = torch.tensor([3.0, 0.5, 3.0], requires_grad=True)
    prediction, target = MODEL.scene.colour_space.prediction_and_target(radiance, photograph)
    (prediction - target).square().sum().backward()
    lamp, too_dark, too_bright = radiance.grad
    assert lamp == 0
    assert too_dark < 0 < too_bright


def test_in_the_authors_arithmetic_nothing_is_encoded_or_clipped() -> None:
    model = RefractiveModel(example_components(), colour="srgb")
    radiance, photograph = 1.2 * torch.rand(50, 3), torch.rand(50, 3).round()
    prediction, target = model.scene.colour_space.prediction_and_target(radiance, photograph)
    assert prediction is radiance
    assert target is photograph
