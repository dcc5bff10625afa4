"""Rays through parts of pixels, and batches that hold them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import nerfro.distributed
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.distributed import drawing_for, rand_rays
from nerfro.pixel_parts import PixelParts
from nerfro.training.ray_batches import RayBatches

NUM_VIEWS, HEIGHT, WIDTH = 3, 8, 10


@pytest.fixture
def cameras(random_pose: Callable[[int], np.ndarray]) -> Cameras:
    poses = torch.from_numpy(np.stack([random_pose(view)[:3] for view in range(NUM_VIEWS)])).float()
    full = torch.ones(NUM_VIEWS)
    return Cameras(poses, 20 * full, 22 * full, 5 * full, 4 * full, WIDTH, HEIGHT, 2.0, 6.0)


@pytest.fixture
def views(cameras: Cameras) -> Views:
    rgb = torch.rand(NUM_VIEWS, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    return Views(cameras, rgb, None, [f"r_{i}" for i in range(NUM_VIEWS)])


@pytest.fixture
def parts(cameras: Cameras) -> PixelParts:
    divided = torch.rand(NUM_VIEWS * HEIGHT * WIDTH, generator=torch.Generator().manual_seed(2)) < 0.3
    return PixelParts(cameras, 2, divided.nonzero()[:, 0])


def test_parts_are_the_pixels_of_cameras_with_as_many_more(cameras: Cameras) -> None:
    pixels = torch.tensor([3, 57, NUM_VIEWS * HEIGHT * WIDTH - 1])
    parts = PixelParts(cameras, 3, pixels)
    assert len(parts) == 27
    finer = cameras.resized(3 * WIDTH, 3 * HEIGHT)
    rays = parts.rays(torch.arange(27))
    view, row, column = pixels // (HEIGHT * WIDTH), pixels // WIDTH % HEIGHT, pixels % WIDTH
    for number in range(27):
        which, x, y = number // 9, number % 9 // 3, number % 3
        expected = finer.rays(view[[which]], 3 * row[[which]] + y, 3 * column[[which]] + x)
        torch.testing.assert_close(rays.directions[number], expected.directions[0])


def test_one_part_of_all_pixels_is_the_pixels(cameras: Cameras) -> None:
    parts = PixelParts(cameras)
    assert len(parts) == NUM_VIEWS * HEIGHT * WIDTH
    for view in range(NUM_VIEWS):
        numbers = torch.arange(view * HEIGHT * WIDTH, (view + 1) * HEIGHT * WIDTH)
        torch.testing.assert_close(parts.rays(numbers).directions, cameras.image_rays(view).directions)


@pytest.mark.parametrize("batching", ["single_image", "all_images"])
def test_divided_pixels_bring_all_their_rays(views: Views, parts: PixelParts, batching: str) -> None:
    whole = RayBatches(views, 40, batching, seed=3)
    drawn, batch = whole.batch(7), whole.dividing(parts).batch(7)
    is_divided = torch.isin(drawn.index, parts.pixels)
    assert batch.num_whole == int((~is_divided).sum())
    assert 0 < batch.num_whole < 40
    assert len(batch.rays) == batch.num_rows == batch.num_whole + 4 * int(is_divided.sum())
    n = batch.num_whole
    assert torch.equal(batch.index[:n], drawn.index[~is_divided])
    assert torch.equal(batch.rays.directions[:n], drawn.rays.directions[~is_divided])
    assert torch.equal(parts.pixels[batch.index[n::4] // 4], drawn.index[is_divided])
    torch.testing.assert_close(batch.rays.directions[n:], parts.rays(batch.index[n:]).directions)
    # Rows of one pixel have its colour, and the pixels are those that were drawn.
    torch.testing.assert_close(batch.of_pixels(batch.rgb), torch.cat([drawn.rgb[~is_divided], drawn.rgb[is_divided]]))


def test_a_pixel_is_the_mean_of_linear_radiance(views: Views, parts: PixelParts) -> None:
    batch = RayBatches(views, 20, seed=1).dividing(parts).batch(0)
    rgb = torch.rand(len(batch.rays), 3)
    pixels, n = batch.of_pixels(rgb), batch.num_whole
    assert torch.equal(pixels[:n], rgb[:n])
    torch.testing.assert_close(pixels[n], rgb[n : n + 4].mean(0))
    assert torch.equal(replace(batch, num_whole=None).of_pixels(rgb), rgb)


def test_processes_share_pixels_and_random_numbers(
    views: Views, parts: PixelParts, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = RayBatches(views, 30, "all_images", seed=3).dividing(parts)
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
        assert len(batch.of_pixels(batch.rgb)) == 10
        assert torch.equal(batch.rays.directions, expected.rays.directions[batch.rows])
        assert torch.equal(batch.index, expected.index[batch.rows])
        assert torch.equal(draw(batch), numbers[batch.rows])
        seen[batch.rows] += 1
    assert (seen == 1).all()
