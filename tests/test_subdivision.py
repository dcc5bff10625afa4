"""Rays through parts of pixels: the choice of pixels, and their batches and renderings."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.core.cameras import Cameras
from nerfro.core.types import Batch
from nerfro.data.base import Views
from nerfro.evaluation.render_view import render_view
from nerfro.media.base import Vacuum
from nerfro.models.refractive import RefractiveModel
from nerfro.paper.hierarchical import Hierarchical
from nerfro.paper.nerf import NerfField
from nerfro.rendering import RayTracer
from nerfro.samplers.base import Straight
from nerfro.samplers.subdivision import Subdivision, contrast, divergence, neighbour_rays, part_rays, pixel_rays
from nerfro.testing import example_batch, example_components
from nerfro.training.pixel_batches import PixelBatches
from tests.cameras_at import cameras_at, random_poses
from tests.closed_forms import Ball, RoundedBox
from tests.reference_tracer import Snell

NUM_VIEWS, HEIGHT, WIDTH = 3, 8, 10
SIDE, FOCAL = 33, 60.0
CUBE = RoundedBox(half_side=0.6, edge_radius=0.05, ior=1.5)


@pytest.fixture
def cameras() -> Cameras:
    return cameras_at(random_poses(NUM_VIEWS), WIDTH, HEIGHT, 20.0, 22.0)


@pytest.fixture
def above() -> Cameras:
    """Looks down on the origin from 4 units above."""
    pose = torch.eye(4)[:3].clone()
    pose[2, 3] = 4.0
    return cameras_at(pose[None], SIDE, SIDE, FOCAL)


@pytest.fixture
def views(above: Cameras) -> Views:
    return Views(above, torch.rand(1, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(1)), None, ["r_0"])


def diverging(cameras: Cameras, sampler, medium) -> torch.Tensor:
    pixels = torch.arange(len(cameras) * cameras.height * cameras.width)
    exits, beside = (sampler(rays(cameras, pixels), medium).exit_directions for rays in (pixel_rays, neighbour_rays))
    return divergence(cameras, pixels, exits, beside)


def test_parts_are_the_pixels_of_cameras_with_higher_resolution(cameras: Cameras) -> None:
    pixels = torch.tensor([3, 57, NUM_VIEWS * HEIGHT * WIDTH - 1])
    rays = part_rays(cameras, pixels, 3)
    finer = cameras.resized(3 * WIDTH, 3 * HEIGHT)
    view, row, column = pixels // (HEIGHT * WIDTH), pixels // WIDTH % HEIGHT, pixels % WIDTH
    for number in range(27):
        which, x, y = number // 9, number % 9 // 3, number % 3
        expected = finer.rays(view[[which]], 3 * row[[which]] + y, 3 * column[[which]] + x)
        torch.testing.assert_close(rays.directions[number], expected.directions[0])


def test_straight_rays_one_pixel_apart_diverge_by_at_most_one_pixel(cameras: Cameras) -> None:
    pixels = torch.arange(NUM_VIEWS * HEIGHT * WIDTH)
    angles = diverging(cameras, Straight(), Vacuum())
    assert angles.max() <= 1.0 + 1e-5
    # On the axis, one pixel on the diagonal is the angle (1 / fx, 1 / fy) / sqrt 2.
    central = pixels % (HEIGHT * WIDTH) == HEIGHT // 2 * WIDTH + WIDTH // 2
    expected = 20 * math.atan(math.hypot(1 / 20, 1 / 22) / math.sqrt(2))
    assert angles[central].min() > 0.95 * expected


def test_divergence_behind_a_ball_matches_its_deviation(above: Cameras) -> None:
    """Deviation 2 (asin b - asin(b / n)) of a ray of impact b: the angle between two rays in a plane with the axis."""
    ball = Ball(0.8, 1.5)
    pixels = torch.arange(SIDE * SIDE)
    diagonal = pixels // SIDE == pixels % SIDE  # there the ray beside lies in the plane of the ray and the axis
    angles = diverging(above, Snell(), ball)[diagonal]

    def leaves(place: np.ndarray) -> np.ndarray:
        seen = np.arctan((place - SIDE / 2) * math.sqrt(2) / FOCAL)
        impact = 4 * np.sin(seen) / 0.8
        turned = np.where(
            abs(impact) < 1, 2 * (np.arcsin(impact.clip(-1, 1)) - np.arcsin((impact / 1.5).clip(-1, 1))), 0
        )
        return seen - turned

    centres = np.arange(SIDE) + 0.5
    expected = FOCAL * abs(leaves(centres + math.sqrt(0.5)) - leaves(centres))
    np.testing.assert_allclose(angles.numpy(), expected, atol=0.01 * FOCAL)


def through_cube(subdivision: Subdivision) -> RayTracer:
    components = replace(example_components(), medium=CUBE, path_sampler=Snell())
    return RayTracer(RefractiveModel(components), subdivision)


def batch_of(views: Views, step: int, subdivision: Subdivision, size: int = 64) -> Batch:
    return through_cube(subdivision).trace(PixelBatches(views, size, "all_images", seed=3).draw(step))


def of_pixels(batch: Batch, divided: bool) -> torch.Tensor:
    """Rows of a batch's pixels that have several rays, or one."""
    return ((torch.bincount(batch.ray_pixel) > 1) == divided).nonzero()[:, 0]


def test_pixels_whose_rays_diverge_have_a_ray_through_each_part(views: Views) -> None:
    batch = batch_of(views, 7, Subdivision(2, 8.0))
    divided, whole = of_pixels(batch, True), of_pixels(batch, False)
    assert 0 < len(divided) < 64
    assert torch.equal(divided, (diverging(views.cameras, Snell(), CUBE)[batch.pixel_number] >= 8.0).nonzero()[:, 0])
    assert torch.equal(batch.teaches_background, (batch.ray_pixel.bincount() == 1))
    assert torch.equal(batch.rgb, views.images.view(-1, 3)[batch.pixel_number])
    expected = part_rays(views.cameras, batch.pixel_number[divided], 2).directions.view(-1, 4, 3)
    for parts, pixel in zip(expected, divided, strict=True):
        torch.testing.assert_close(batch.rays.directions[batch.ray_pixel == pixel], parts)
    of_whole = torch.isin(batch.ray_pixel, whole)
    directions = pixel_rays(views.cameras, batch.pixel_number[batch.ray_pixel[of_whole]]).directions
    torch.testing.assert_close(batch.rays.directions[of_whole], directions)


def test_pixels_of_the_object_are_divided_for_their_contrast(views: Views) -> None:
    images = torch.zeros(1, SIDE, SIDE, 3)
    images[:, :, 20:] = 0.5  # an edge down the photograph, beside the cube and through it
    fine = replace(views, images=images)
    batch = batch_of(fine, 1, Subdivision(2, 8.0, 0.1, contrast_start=1), 1000)
    angles = diverging(views.cameras, Snell(), CUBE)[batch.pixel_number]
    refracted = Snell()(pixel_rays(views.cameras, batch.pixel_number), CUBE).refracted
    edge = torch.isin(batch.pixel_number % SIDE, torch.tensor([19, 20]))
    assert (edge & refracted & (angles < 8)).sum() > 5
    assert (edge & ~refracted).any(), "the sky beside the object is not divided"
    expected = (angles >= 8) | (edge & refracted)
    assert torch.equal(of_pixels(batch, True), expected.nonzero()[:, 0])
    assert torch.equal(batch.teaches_background, angles < 8)
    before = batch_of(fine, 0, Subdivision(2, 8.0, 0.1, contrast_start=1), 1000)
    assert torch.equal(of_pixels(before, True), (~before.teaches_background).nonzero()[:, 0])


def test_zero_divergence_divides_all_pixels_and_steady_pixels_train_the_background(views: Views) -> None:
    batch = batch_of(views, 1, Subdivision(2, 0.0), 1000)
    assert len(of_pixels(batch, False)) == 0
    angles = diverging(views.cameras, Snell(), CUBE)[batch.pixel_number]
    assert (angles >= 8).any()
    assert torch.equal(batch.teaches_background, angles < 8)


def test_contrast_is_the_largest_step_to_a_neighbour(cameras: Cameras) -> None:
    images = torch.rand(NUM_VIEWS, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(2))
    pixels = torch.arange(NUM_VIEWS * HEIGHT * WIDTH)
    flat = images.view(-1, 3)
    expected = torch.zeros(NUM_VIEWS, HEIGHT, WIDTH)
    for row, column in np.ndindex(HEIGHT, WIDTH):
        around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
        for r, c in around:
            if 0 <= r < HEIGHT and 0 <= c < WIDTH:
                step = (images[:, r, c] - images[:, row, column]).abs().amax(-1)
                expected[:, row, column] = torch.maximum(expected[:, row, column], step)
    assert torch.equal(contrast(lambda some: flat[some], cameras, pixels), expected.flatten())


def test_batches_and_renderings_do_not_depend_on_the_process_or_the_chunk(views: Views) -> None:
    """Each pixel has the same rays, paths, numbers and samples, whoever traces it and beside whichever others."""
    batches, tracer = PixelBatches(views, 60, "all_images", seed=3), through_cube(Subdivision(2, 8.0, 0.2))
    whole = tracer.trace(batches.draw(4))
    model = RefractiveModel(replace(example_components(), point_sampler=Hierarchical(8, 8)))
    sampled = model.render_path(whole.path, whole)[-1].samples.s
    assert len(whole.draws.ray.unique()) == len(whole.rays) > 60
    for rank in range(3):
        share, own = tracer.trace(batches.for_rank(rank, 3).draw(4)), torch.arange(20 * rank, 20 * (rank + 1))
        for name in ("pixel_number", "rgb", "view", "teaches_background"):
            assert torch.equal(getattr(share, name), getattr(whole, name)[own])
        rows = torch.isin(whole.ray_pixel, own).nonzero()[:, 0]
        assert torch.equal(share.ray_pixel + 20 * rank, whole.ray_pixel[rows])
        assert torch.equal(share.draws.ray, whole.draws.ray[rows])
        assert torch.equal(share.rays.directions, whole.rays.directions[rows])
        assert torch.equal(share.path.exit_directions, whole.path.exit_directions[rows])
        torch.testing.assert_close(model.render_path(share.path, share)[-1].samples.s, sampled[rows])


def test_straight_rays_do_not_diverge_and_need_one_ray_per_pixel() -> None:
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


def test_pixels_with_high_contrast_are_divided_without_refraction() -> None:
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
