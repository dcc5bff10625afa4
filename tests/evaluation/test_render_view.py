"""Pixels with several rays: only those need them beside which rays part."""

from dataclasses import replace

import torch

from nerfro.evaluation.render_view import render_view
from nerfro.media.shapes import Ball
from nerfro.models.refractive import RefractiveModel
from nerfro.samplers.paths.snell import Snell
from nerfro.subdivision import Subdivision
from nerfro.testing import example_batch, example_components
from tests.paper import NerfField


def test_straight_rays_part_nowhere_and_need_one_ray_a_pixel() -> None:
    model, cameras = RefractiveModel(example_components()).eval(), example_batch().cameras
    once, divided = (render_view(model, cameras, 0, Subdivision(side, 1.5)) for side in (1, 3))
    assert torch.equal(divided.radiance, once.radiance)


def test_pixels_are_divided_at_the_rim_of_a_ball() -> None:
    parts = replace(example_components(), medium=Ball(), path_sampler=Snell())
    model, cameras = RefractiveModel(parts).eval(), example_batch().cameras
    for parameter in model.scene.fields.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    once, divided = (render_view(model, cameras, 0, Subdivision(side, 8.0)).radiance for side in (1, 3))
    differs = (once != divided).any(-1)
    assert 0 < differs.float().mean() < 0.5


def test_pixels_of_much_contrast_are_divided_where_no_ray_bends() -> None:
    smooth = replace(example_components(), make_field=lambda: NerfField(width=16, depth=2, skip=1, view_width=8))
    model, cameras = RefractiveModel(smooth).eval(), example_batch().cameras
    for parameter in model.scene.fields.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    once = render_view(model, cameras, 0, Subdivision(1))
    shown = model.scene.colour_space.to_srgb(once.radiance).clamp(0, 1).view(cameras.height, cameras.width, 3)
    threshold = 0.02
    steps = [(shown.diff(dim=axis).abs().amax(-1) >= threshold) for axis in (0, 1)]
    expected = torch.zeros(cameras.height, cameras.width, dtype=torch.bool)
    expected[:-1] |= steps[0]
    expected[1:] |= steps[0]
    expected[:, :-1] |= steps[1]
    expected[:, 1:] |= steps[1]
    assert 0 < expected.float().mean() < 1
    divided = render_view(model, cameras, 0, Subdivision(3, 1.5, threshold))
    assert torch.equal((divided.radiance != once.radiance).any(-1), expected.flatten())
