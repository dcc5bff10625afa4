"""Rays through parts of pixels, the pixels that need them, and batches that hold them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import nerfro.distributed
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.distributed import drawing_for, rand_rays
from nerfro.media.analytic import Vacuum
from nerfro.media.shapes import Ball, RoundedBox
from nerfro.pixel_parts import contrast, divergence, part_rays, pixel_rays, rays_beside
from nerfro.samplers.snell import Snell
from nerfro.samplers.straight import Straight
from nerfro.training.ray_batches import RayBatches

NUM_VIEWS, HEIGHT, WIDTH = 3, 8, 10
SIDE, FOCAL = 33, 60.0
CUBE = RoundedBox(half_side=0.6, edge_radius=0.05, ior=1.5)


@pytest.fixture
def cameras(random_pose: Callable[[int], np.ndarray]) -> Cameras:
    poses = torch.from_numpy(np.stack([random_pose(view)[:3] for view in range(NUM_VIEWS)])).float()
    full = torch.ones(NUM_VIEWS)
    return Cameras(poses, 20 * full, 22 * full, 5 * full, 4 * full, WIDTH, HEIGHT, 2.0, 6.0)


@pytest.fixture
def above() -> Cameras:
    """Looks down on the origin from 4 units above."""
    pose = torch.eye(4)[:3].clone()
    pose[2, 3] = 4.0
    one = torch.ones(1)
    return Cameras(pose[None], FOCAL * one, FOCAL * one, SIDE / 2 * one, SIDE / 2 * one, SIDE, SIDE, 2.0, 6.0)


@pytest.fixture
def views(above: Cameras) -> Views:
    return Views(above, torch.rand(1, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(1)), None, ["r_0"])


def through_cube(rays, view):
    assert len(view) == len(rays)
    return Snell()(rays, CUBE)


def diverging(cameras: Cameras, sampler, medium) -> torch.Tensor:
    pixels = torch.arange(len(cameras) * cameras.height * cameras.width)
    exits, beside = (sampler(rays(cameras, pixels), medium).exit_directions for rays in (pixel_rays, rays_beside))
    return divergence(cameras, pixels, exits, beside)


def test_parts_are_the_pixels_of_cameras_with_as_many_more(cameras: Cameras) -> None:
    pixels = torch.tensor([3, 57, NUM_VIEWS * HEIGHT * WIDTH - 1])
    rays = part_rays(cameras, pixels, 3)
    finer = cameras.resized(3 * WIDTH, 3 * HEIGHT)
    view, row, column = pixels // (HEIGHT * WIDTH), pixels // WIDTH % HEIGHT, pixels % WIDTH
    for number in range(27):
        which, x, y = number // 9, number % 9 // 3, number % 3
        expected = finer.rays(view[[which]], 3 * row[[which]] + y, 3 * column[[which]] + x)
        torch.testing.assert_close(rays.directions[number], expected.directions[0])


def test_straight_rays_one_pixel_apart_diverge_by_one_pixel_at_most(cameras: Cameras) -> None:
    pixels = torch.arange(NUM_VIEWS * HEIGHT * WIDTH)
    angles = diverging(cameras, Straight(), Vacuum())
    assert angles.max() <= 1.0 + 1e-5
    # On the axis, one pixel on the diagonal is the angle (1 / fx, 1 / fy) / sqrt 2.
    central = pixels % (HEIGHT * WIDTH) == HEIGHT // 2 * WIDTH + WIDTH // 2
    expected = 20 * math.atan(math.hypot(1 / 20, 1 / 22) / math.sqrt(2))
    assert angles[central].min() > 0.95 * expected


def test_divergence_behind_a_ball_is_that_of_its_deviation(above: Cameras) -> None:
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


def test_rim_of_a_cube_diverges_and_its_face_does_not(above: Cameras) -> None:
    divergent = (diverging(above, Snell(), CUBE) >= 8.0).view(SIDE, SIDE)
    # Half the top face's side in pixels; the rim lies there.
    rim = 0.6 * FOCAL / (4.0 - 0.6)
    offsets = (torch.arange(SIDE) + 0.5 - SIDE / 2).abs()
    away, along = torch.maximum(offsets[:, None], offsets), torch.minimum(offsets[:, None], offsets)
    assert not divergent[away < rim - 3].any()
    assert not divergent[away > rim + 2].any()
    beside_rim = ((away - rim).abs() < 0.8) & (along < rim - 2)  # corners apart, which are rounded twice
    assert divergent[beside_rim].float().mean() > 0.5


@pytest.mark.parametrize("batching", ["single_image", "all_images"])
def test_divided_pixels_bring_all_their_rays(views: Views, batching: str) -> None:
    whole = RayBatches(views, 64, batching, seed=3)
    drawn, batch = whole.batch(7), whole.traced(through_cube, 2, 8.0).batch(7)
    angles = diverging(views.cameras, Snell(), CUBE)[drawn.index]
    n = batch.num_whole
    assert 0 < n < 64
    assert len(batch.rays) == batch.num_rows == n + 4 * (64 - n)
    divided = batch.index[n::4]
    assert torch.equal(divided.repeat_interleave(4), batch.index[n:])
    assert torch.equal(torch.cat([batch.index[:n], divided]).sort().values, drawn.index.sort().values)
    # All that diverge are divided, and the widest of the others, up to the next multiple of a 32nd of the batch.
    wide = drawn.index[angles >= 8.0]
    assert set(wide.tolist()) <= set(divided.tolist())
    assert len(divided) == -(-len(wide) // 2) * 2
    assert torch.equal(batch.rgb, views.images.view(-1, 3)[batch.index])
    torch.testing.assert_close(batch.rays.directions[n:], part_rays(views.cameras, divided, 2).directions)
    torch.testing.assert_close(batch.rays.directions[:n], pixel_rays(views.cameras, batch.index[:n]).directions)


@pytest.mark.parametrize("rank", [0, 1])
def test_pixels_of_the_object_are_divided_for_their_contrast(views: Views, rank: int) -> None:
    images = torch.zeros(1, SIDE, SIDE, 3)
    images[:, :, 20:] = 0.5  # an edge down the photograph, beside the cube and through it
    fine = dataclasses.replace(views, images=images)
    batches = RayBatches(fine, 1000, "all_images", seed=3).share(rank, 2)
    batch = batches.traced(through_cube, 2, 8.0, 0.1).batch(0)
    n, end = batch.num_whole, batch.num_together
    divided, parted = batch.index[n:end:4], batch.index[end::4]
    assert torch.equal(divided.repeat_interleave(4), batch.index[n:end])
    angles = diverging(views.cameras, Snell(), CUBE)
    refracted = Snell()(pixel_rays(views.cameras, torch.arange(SIDE**2)), CUBE).refracted
    edge = torch.isin(torch.arange(SIDE**2) % SIDE, torch.tensor([19, 20]))
    assert (refracted & (angles < 8))[divided].all()
    assert edge[divided].sum() > 5
    assert (edge & refracted)[batch.index[:n]].sum() == 0, "none is left whole"
    assert (edge & ~refracted)[batch.index[:n]].any(), "the sky beside the object is"
    assert (angles[parted] >= angles[divided].max()).all()
    torch.testing.assert_close(batch.rays.directions[n:end], part_rays(views.cameras, divided, 2).directions)
    before = batches.traced(through_cube, 2, 8.0, 0.1, contrast_start=1).batch(0)
    assert before.num_together == before.num_whole == n + len(divided)


@pytest.mark.parametrize("jitter", [False, True])
def test_paths_of_a_batch_are_those_of_its_rays(views: Views, jitter: bool) -> None:
    batch = RayBatches(views, 200, jitter=jitter).traced(through_cube, 2, 4.0).batch(0)
    traced = Snell()(batch.rays, CUBE)
    s = torch.linspace(2.0, 6.0, 50).expand(len(batch.rays), -1)
    for a, b in zip(batch.path.at(s), traced.at(s), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)
    torch.testing.assert_close(batch.path.exit_directions, traced.exit_directions, rtol=0, atol=1e-5)
    assert torch.equal(batch.path.refracted, traced.refracted)


def test_jittered_parts_stay_inside_their_parts_and_fill_them(views: Views) -> None:
    batches = RayBatches(views, 200, seed=0, jitter=True).traced(through_cube, 2, 4.0)
    offsets = []
    for step in range(4):
        batch = batches.batch(step)
        n = batch.num_whole
        x, y, z = batch.rays.directions[n:].unbind(-1)
        column, row = SIDE / 2 - FOCAL * x / z, SIDE / 2 + FOCAL * y / z
        place = torch.stack([column - batch.index[n:] % SIDE, row - batch.index[n:] // SIDE], -1).view(-1, 2, 2, 2)
        corners = 0.5 * torch.stack(torch.meshgrid(torch.arange(2), torch.arange(2), indexing="ij"), -1)
        offsets.append(((place - corners) * 2).view(-1, 2))
    offset = torch.cat(offsets)
    assert offset.min() > -1e-3
    assert offset.max() < 1 + 1e-3
    assert torch.allclose(offset.mean(0), torch.tensor(0.5), atol=4 * 12**-0.5 * len(offset) ** -0.5)
    assert torch.allclose(offset.std(0), torch.tensor(12**-0.5), atol=0.02)


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


def test_where_nothing_bends_no_pixel_is_divided(views: Views) -> None:
    batch = RayBatches(views, 50).traced(lambda rays, view: Straight()(rays, Vacuum()), 2, 1.1).batch(0)
    assert batch.num_whole == len(batch.rays) == 50


def test_a_pixel_is_the_mean_of_linear_radiance(views: Views) -> None:
    batch = RayBatches(views, 64, seed=1).traced(through_cube, 2, 8.0).batch(0)
    rgb = torch.rand(len(batch.rays), 3)
    pixels, n = batch.of_pixels(rgb), batch.num_whole
    assert torch.equal(pixels[:n], rgb[:n])
    torch.testing.assert_close(pixels[n], rgb[n : n + 4].mean(0))
    assert torch.equal(replace(batch, num_whole=None).of_pixels(rgb), rgb)


def test_processes_share_pixels_and_random_numbers(views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    batches = RayBatches(views, 60, "all_images", seed=3, jitter=True).traced(through_cube, 2, 8.0)
    expected = batches.batch(4)
    like = torch.zeros((), dtype=torch.float64)

    def draw(batch) -> torch.Tensor:
        torch.manual_seed(5)
        with drawing_for(batch.rows, batch.num_rows):
            return rand_rays(len(batch.rays), 3, like)

    numbers = draw(expected)
    torch.manual_seed(5)
    assert torch.equal(numbers, rand_rays(len(expected.rays), 3, like)), "one process draws as ever"
    monkeypatch.setattr(nerfro.distributed, "rank_and_size", lambda: (0, 3))
    seen = torch.zeros(len(expected.rays))
    for rank in range(3):
        batch = batches.share(rank, 3).batch(4)
        assert len(batch.of_pixels(batch.rgb)) == 20
        for name in ("index", "rgb", "view"):
            assert torch.equal(getattr(batch, name), getattr(expected, name)[batch.rows])
        assert torch.equal(batch.rays.directions, expected.rays.directions[batch.rows])
        assert torch.equal(batch.path.exit_directions, expected.path.exit_directions[batch.rows])
        assert torch.equal(draw(batch), numbers[batch.rows])
        seen[batch.rows] += 1
    assert (seen == 1).all()
