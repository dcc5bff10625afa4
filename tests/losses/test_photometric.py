"""The re-rendering error of pixels that have one ray, and of those that have several."""

from __future__ import annotations

import dataclasses

import torch
from torch.func import functional_call

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.light import to_srgb
from nerfro.losses.boundary import BoundaryRegulariser
from nerfro.losses.photometric import Photometric
from nerfro.models.refractive import RefractiveModel
from nerfro.testing import example_parts
from nerfro.types import Batch, Exits, Path, Rendering, Samples

NUM_WHOLE, NUM_DIVIDED, PARTS = 3, 2, 4
NUM_RAYS = NUM_WHOLE + NUM_DIVIDED * PARTS
MODEL = RefractiveModel(example_parts())


def rendering(colour: torch.Tensor, boundary: torch.Tensor, passed: torch.Tensor) -> Rendering:
    vectors = torch.zeros(NUM_RAYS, 2, 3)
    ends = torch.tensor([[2.0, 6.0]]).expand(NUM_RAYS, 2)
    path = Path(vectors, vectors, ends, vectors[:, 0], torch.ones(NUM_RAYS, dtype=torch.bool), torch.ones(NUM_RAYS))
    samples = Samples(vectors[:, :1], vectors[:, :1], ends[:, :1], ends, torch.ones(NUM_RAYS))
    rgb = (1 - passed)[:, None] * colour + passed[:, None] * boundary
    return Rendering(rgb, (1 - passed)[:, None], passed, boundary, samples, path)


def batch() -> Batch:
    pixels = torch.rand(NUM_WHOLE + NUM_DIVIDED, 3)
    rgb = torch.cat([pixels[:NUM_WHOLE], pixels[NUM_WHOLE:].repeat_interleave(PARTS, 0)])
    return Batch(None, None, rgb, None, num_whole=NUM_WHOLE, num_together=NUM_WHOLE, rays_per_pixel=PARTS)  # type: ignore[arg-type]


def test_a_divided_pixel_is_compared_as_a_whole_and_teaches_the_field_alone() -> None:
    colour, boundary = (torch.rand(NUM_RAYS, 3, requires_grad=True) for _ in range(2))
    given, passed = batch(), torch.rand(NUM_RAYS)
    rendered = rendering(colour, boundary, passed)
    loss = Photometric()([rendered], given, MODEL)
    parts = rendered.rgb[NUM_WHOLE:].view(NUM_DIVIDED, PARTS, 3)
    pixels = to_srgb(torch.cat([rendered.rgb[:NUM_WHOLE], parts.mean(1)]))
    target = torch.cat([given.rgb[:NUM_WHOLE], given.rgb[NUM_WHOLE::PARTS]])
    expected = (pixels - target).square().mean()
    torch.testing.assert_close(loss, expected)
    of_colour, of_boundary = torch.autograd.grad(loss, [colour, boundary], retain_graph=True)
    whole_colour, whole_boundary = torch.autograd.grad(expected, [colour, boundary])
    torch.testing.assert_close(of_colour, whole_colour)
    torch.testing.assert_close(of_boundary[:NUM_WHOLE], whole_boundary[:NUM_WHOLE])
    assert whole_boundary[NUM_WHOLE:].abs().min() > 0
    torch.testing.assert_close(of_boundary[NUM_WHOLE:], torch.zeros(NUM_DIVIDED * PARTS, 3), rtol=0, atol=1e-7)


def test_a_divided_pixel_whose_rays_stay_together_teaches_the_boundary() -> None:
    colour, boundary = (torch.rand(NUM_RAYS, 3, requires_grad=True) for _ in range(2))
    given = dataclasses.replace(batch(), num_together=NUM_WHOLE + PARTS)  # the first of two divided pixels
    loss = Photometric()([rendering(colour, boundary, torch.rand(NUM_RAYS))], given, MODEL)
    (of_boundary,) = torch.autograd.grad(loss, boundary)
    assert of_boundary[: NUM_WHOLE + PARTS].abs().min() > 0
    torch.testing.assert_close(of_boundary[NUM_WHOLE + PARTS :], torch.zeros(PARTS, 3), rtol=0, atol=1e-7)


def test_what_bends_rays_learns_from_divided_pixels_and_the_sky_does_not() -> None:
    sky = EnvironmentMap([4])
    torch.nn.init.normal_(sky.texels)
    model = RefractiveModel(dataclasses.replace(example_parts(), boundary=sky))
    directions = torch.nn.functional.normalize(torch.randn(NUM_RAYS, 3), dim=-1).requires_grad_()
    given, passed, colour = batch(), torch.rand(NUM_RAYS), torch.rand(NUM_RAYS, 3)

    def loss(held: bool) -> torch.Tensor:
        """By hand: the same pixels, of which the divided ones see a sky that is held."""
        whole, divided = directions[:NUM_WHOLE], directions[NUM_WHOLE:]
        fixed = (
            functional_call(sky, {"texels": sky.texels.detach()}, (Exits(divided),)) if held else sky(Exits(divided))
        )
        seen = (1 - passed)[:, None] * colour + passed[:, None] * torch.cat([sky(Exits(whole)), fixed])
        pixels = torch.cat([seen[:NUM_WHOLE], seen[NUM_WHOLE:].view(NUM_DIVIDED, PARTS, 3).mean(1)])
        target = torch.cat([given.rgb[:NUM_WHOLE], given.rgb[NUM_WHOLE::PARTS]])
        return (to_srgb(pixels) - target).square().mean()

    rendered = rendering(colour, sky(Exits(directions)), passed)
    path = dataclasses.replace(rendered.path, exit_directions=directions)
    value = Photometric()([dataclasses.replace(rendered, path=path)], given, model)
    found = torch.autograd.grad(value, [directions, sky.texels])
    for gradient, expected in zip(found, torch.autograd.grad(loss(held=True), [directions, sky.texels]), strict=True):
        torch.testing.assert_close(gradient, expected)
    assert not torch.allclose(found[1], torch.autograd.grad(loss(held=False), sky.texels)[0])


def test_parts_of_a_pixel_need_not_have_its_colour_for_the_regulariser() -> None:
    given, passed = batch(), torch.full((NUM_RAYS,), 0.9, requires_grad=True)
    rendered = rendering(torch.rand(NUM_RAYS, 3), torch.rand(NUM_RAYS, 3), passed)
    value = BoundaryRegulariser()([rendered], given, MODEL)
    (gradient,) = torch.autograd.grad(value, passed)
    assert (gradient[:NUM_WHOLE] != 0).all()
    assert (gradient[NUM_WHOLE:] == 0).all()


def test_a_saturated_pixel_is_no_error_where_both_clip_and_keeps_a_gradient_where_one_does() -> None:
    photograph = torch.tensor([1.0, 1.0, 0.6])  # saturated, saturated, not
    radiance = torch.tensor([3.0, 0.5, 3.0], requires_grad=True)
    prediction, target = MODEL.difference(radiance, photograph)
    (prediction - target).square().sum().backward()
    lamp, too_dark, too_bright = radiance.grad
    assert lamp == 0
    assert too_dark < 0 < too_bright


def test_in_the_authors_arithmetic_nothing_is_encoded_or_clipped() -> None:
    model = RefractiveModel(example_parts(), colour="srgb")
    radiance, photograph = 1.2 * torch.rand(50, 3), torch.rand(50, 3).round()
    prediction, target = model.difference(radiance, photograph)
    assert prediction is radiance
    assert target is photograph
