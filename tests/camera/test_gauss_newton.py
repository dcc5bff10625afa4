"""Cameras find back to a scene that is known, each by itself, and the lens that they share."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.cameras import disturbed
from nerfro.camera.similarity import motion_between
from nerfro.light import to_srgb
from nerfro.rays import Rays
from nerfro.samplers.paths.snell import Snell
from tests.ball_photographs import NUM_VIEWS, SIZE, cameras, sky, solid
from tests.camera.refined_cameras import PriorInformation, RefinedCamera, gauss_newton
from tests.pretended_gpu import GPU, PretendedGpu

MEDIUM = solid([1.45])


def shown(rays: Rays, view: Tensor) -> Tensor:
    """A ball of glass before a smooth sky."""
    return to_srgb(sky(Snell()(rays, MEDIUM).exit_directions))


TRUE = cameras()
PHOTOGRAPHS = torch.cat([shown(TRUE.image_rays(view), torch.tensor(view)) for view in range(NUM_VIEWS)])


def photographed(pixels: Tensor) -> Tensor:
    return PHOTOGRAPHS[pixels]


def looked_at(step: int, num: int = 300) -> Tensor:
    generator = torch.Generator().manual_seed(step)
    drawn = torch.randint(SIZE * SIZE, (NUM_VIEWS, 2 * num), generator=generator)
    pixels = drawn + SIZE * SIZE * torch.arange(NUM_VIEWS)[:, None]
    return gauss_newton.informative_pixels(pixels, num, photographed, TRUE)


def steps(camera: RefinedCamera, given: object, how: gauss_newton.Step, num: int) -> None:
    for step in range(num):
        gauss_newton.gauss_newton_step(camera, given, looked_at(step), photographed, shown, how)


def test_disturbed_cameras_find_back_by_what_is_seen_through_the_ball() -> None:
    given = replace(TRUE, camera_to_world=disturbed(TRUE, math.radians(0.5), 0.01, 0).float())
    camera = RefinedCamera(fix_gauge=False)
    camera.begin(given)
    steps(camera, given, gauss_newton.Step(difference_pixels=0.5, scale=0.3, max_pixels=3.0), 6)
    before = motion_between(TRUE.camera_to_world, given.camera_to_world)
    after = motion_between(TRUE.camera_to_world, camera.estimated(given).camera_to_world)
    for old, new in zip(before, after, strict=True):
        assert float(new.median()) < 0.06 * float(old.median())


def test_the_lens_that_all_share_is_found_with_them() -> None:
    given = replace(TRUE, fx=1.02 * TRUE.fx, fy=1.02 * TRUE.fy, cx=TRUE.cx + 0.5, cy=TRUE.cy - 0.3)
    camera = RefinedCamera(lens=True, fix_gauge=False)
    camera.begin(given)
    steps(camera, given, gauss_newton.Step(difference_pixels=0.5, scale=0.3, max_pixels=3.0), 8)
    found = camera.estimated(given)
    assert float(found.fx[0]) == pytest.approx(float(TRUE.fx[0]), rel=2e-3)
    assert float(found.cx[0]) == pytest.approx(float(TRUE.cx[0]), abs=0.1)
    assert float(found.cy[0]) == pytest.approx(float(TRUE.cy[0]), abs=0.1)


def test_steps_vanish_at_the_truth_and_have_a_limit() -> None:
    camera = RefinedCamera(fix_gauge=False)
    camera.begin(TRUE)
    wrong = 1 - PHOTOGRAPHS

    def inverted(pixels: Tensor) -> Tensor:
        return wrong[pixels]

    far = gauss_newton.Step(difference_pixels=0.5, scale=10.0, max_pixels=0.25)
    gauss_newton.gauss_newton_step(camera, TRUE, looked_at(0), inverted, shown, far)
    assert float(camera.motions.motion.norm(dim=-1).max()) == pytest.approx(0.25, rel=1e-4)
    camera.begin(TRUE)
    gauss_newton.gauss_newton_step(camera, TRUE, looked_at(0), photographed, shown, gauss_newton.Step(0.5, 0.3, 3.0))
    assert float(camera.motions.motion.abs().max()) < 1e-4


def test_pixels_with_contrast_are_looked_at_first() -> None:
    pictures = PHOTOGRAPHS.view(NUM_VIEWS, SIZE, SIZE, 3).clone()
    pictures[:, :, : SIZE // 2] = 0.5
    flat = pictures.view(-1, 3)
    drawn = torch.randint(SIZE * SIZE, (NUM_VIEWS, 400)) + SIZE * SIZE * torch.arange(NUM_VIEWS)[:, None]
    chosen = gauss_newton.informative_pixels(drawn, 50, lambda pixels: flat[pixels], TRUE)
    assert chosen.shape == (50 * NUM_VIEWS,)
    assert (chosen.view(NUM_VIEWS, 50) // SIZE**2 == torch.arange(NUM_VIEWS)[:, None]).all()
    assert float((chosen % SIZE >= SIZE // 2 - 1).float().mean()) > 0.95


def test_a_resumed_step_on_a_gpu_uses_what_the_checkpoint_holds_on_the_cpu() -> None:
    """A camera whose prior is certain stays."""
    camera = RefinedCamera(fix_gauge=False)
    camera.begin(TRUE)
    size = camera.numbers().numel()
    prior = PriorInformation(torch.zeros(size), 1e12 * torch.eye(size).double())
    with PretendedGpu():
        camera, given = camera.to(GPU), TRUE.to(GPU)
        pixels, pictures = looked_at(0, 20).to(GPU), 1 - PHOTOGRAPHS.to(GPU)
        sky_alone = lambda rays, view: to_srgb(sky(rays.directions))  # noqa: E731
        step = gauss_newton.Step(difference_pixels=0.5, scale=10.0, max_pixels=0.25)
        gauss_newton.gauss_newton_step(camera, given, pixels, lambda chosen: pictures[chosen], sky_alone, step, [prior])
        assert float(camera.motions.motion.abs().max()) < 1e-4
