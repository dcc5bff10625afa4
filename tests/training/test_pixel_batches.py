"""Random training pixels: their selection, frequency and reproducibility."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.data.base import Views
from nerfro.models.refractive import RefractiveModel
from nerfro.rendering import RayTracer
from nerfro.samplers.subdivision import Subdivision
from nerfro.testing import example_components
from nerfro.training.pixel_batches import PixelBatches
from tests.cameras_at import cameras_at, random_poses
from tests.closed_forms import Ball
from tests.conftest import refused
from tests.reference_tracer import Snell

NUM_VIEWS, HEIGHT, WIDTH = 5, 12, 16


@pytest.fixture
def views() -> Views:
    """Views whose colours name the pixel: view, row and column."""
    cameras = cameras_at(random_poses(NUM_VIEWS), WIDTH, HEIGHT, 20.0)
    index = torch.meshgrid(*(torch.arange(n) for n in (NUM_VIEWS, HEIGHT, WIDTH)), indexing="ij")
    return Views(cameras, torch.stack(index, -1).float() / 16, None, [f"r_{i}" for i in range(NUM_VIEWS)])


@pytest.fixture
def masked(views) -> Views:
    """The same views, of whose pixels a half, a tenth, and in the third one but one, may not be trained on."""
    share = torch.tensor([0.5, 0.1, 0, 0.5, 0.1])[:, None, None]
    usable = torch.rand(NUM_VIEWS, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) >= share
    usable[2] = False
    usable[2, 5, 7] = True
    return replace(views, usable=usable)


def place(index: torch.Tensor) -> torch.Tensor:
    """View, row and column [R, 3] of ray identities, the slow way."""
    return torch.tensor(np.stack(np.unravel_index(index.numpy(), (NUM_VIEWS, HEIGHT, WIDTH)), -1))


@pytest.mark.parametrize("batching", ["single_image", "all_images"])
def test_rays_and_colours_belong_to_the_index(views, batching):
    batch = PixelBatches(views, 50, batching, seed=3).draw(7)
    view, row, column = place(batch.number).unbind(-1)
    assert torch.equal(batch.rgb, torch.stack([view, row, column], -1).float() / 16)
    assert torch.equal(batch.view, view)


@pytest.mark.parametrize("batching", ["single_image", "all_images"])
def test_batch_depends_on_seed_and_step_alone(views, batching):
    batches = PixelBatches(views, 30, batching, seed=3)
    in_order = [batches.draw(step) for step in range(6)]
    again = PixelBatches(views, 30, batching, seed=3)
    for step in (5, 0, 3):
        assert torch.equal(again.draw(step).number, in_order[step].number)
    other = PixelBatches(views, 30, batching, seed=4)
    assert not torch.equal(other.draw(0).number, in_order[0].number)
    assert not torch.equal(in_order[0].number, in_order[1].number)


@pytest.mark.parametrize(
    ("given", "batching"), [("views", "single_image"), ("views", "all_images"), ("masked", "all_images")]
)
def test_masked_pixels_are_never_drawn_and_all_others_equally_often(given, batching, request):
    given = request.getfixturevalue(given)
    batches = PixelBatches(given, 96, batching, seed=0)
    counts = torch.zeros(NUM_VIEWS * HEIGHT * WIDTH)
    for step in range(800):
        counts += torch.bincount(batches.draw(step).number, minlength=len(counts))
    usable = torch.ones(len(counts), dtype=torch.bool) if given.usable is None else given.usable.flatten()
    mean = 800 * 96 / int(usable.sum())
    assert counts[~usable].sum() == 0
    assert (counts[usable] - mean).abs().max() < 6 * mean**0.5


@pytest.mark.parametrize("kind", ["views", "masked"])
def test_rows_share_all_usable_pixels(kind, request):
    given = request.getfixturevalue(kind)
    batches = PixelBatches(given, 8, "all_images")
    parts = [batches.rows(part, 7) for part in range(7)]
    assert torch.equal(given.cameras.view_of(parts[0]), place(parts[0])[:, 0])
    expected = torch.arange(NUM_VIEWS * HEIGHT * WIDTH)
    expected = expected if given.usable is None else expected[given.usable.flatten()]
    assert torch.equal(torch.cat(parts).sort().values, expected)
    assert min(map(len, parts)) > len(expected) / 7 - 2 * WIDTH


def test_masked_batch_of_one_image_is_different_usable_pixels_of_it(masked):
    seen = set()
    for step in range(200):
        index = PixelBatches(masked, 1, "single_image", seed=0).draw(step).number
        assert masked.usable.flatten()[index].all()
        seen.add(int(index) // (HEIGHT * WIDTH))
    assert seen == set(range(NUM_VIEWS))  # views are drawn alike, whatever their masks leave
    two = Views(masked.cameras, masked.images, None, masked.names, masked.usable.clone())
    two.usable[2, 4:6] = True
    smallest = int(two.usable.sum((1, 2)).min())
    for step in range(20):
        batch = PixelBatches(two, smallest, "single_image", seed=0).draw(step)
        assert two.usable.flatten()[batch.number].all()
        assert len(batch.number.unique()) == smallest
        assert len((batch.number // (HEIGHT * WIDTH)).unique()) == 1


def test_object_fraction_of_the_pixels_is_of_the_object(views, masked):
    masks = torch.zeros(NUM_VIEWS, HEIGHT, WIDTH)
    masks[1, 2:5, 3:7] = 1.0
    masks[4, 6, 6:9] = 0.7
    masks[4, 7] = 0.4  # covered by less than a half
    of_object = (masks > 0.5).flatten()
    for given in (views, masked):
        batches = PixelBatches(replace(given, masks=masks), 64, "all_images", seed=0, object_fraction=0.25)
        wanted = of_object if given.usable is None else of_object & given.usable.flatten()
        counts = torch.zeros(len(wanted))
        for step in range(300):
            counts += torch.bincount(batches.draw(step).number, minlength=len(counts))
        usable = torch.ones_like(wanted) if given.usable is None else given.usable.flatten()
        others, own = 300 * 48 / int(usable.sum()), 300 * 16 / int(wanted.sum())
        expected = torch.where(usable, others, 0.0) + torch.where(wanted, own, 0.0)
        assert ((counts - expected).abs() <= 6 * expected.sqrt()).all()
        processes = [batches.for_rank(rank, 2).draw(3).number for rank in range(2)]
        assert torch.equal(torch.cat(processes), batches.draw(3).number)
        assert min(int(wanted[index].sum()) for index in processes) >= 8


def test_object_fraction_is_ignored_without_masks(views, capsys):
    batches = PixelBatches(views, 64, "all_images", seed=3, object_fraction=0.25)
    assert "not every training photograph has a mask" in capsys.readouterr().out
    assert torch.equal(batches.draw(5).number, PixelBatches(views, 64, "all_images", seed=3).draw(5).number)


def test_pixels_of_an_object_need_all_images_and_an_object(views):
    masks = torch.zeros(NUM_VIEWS, HEIGHT, WIDTH)
    refused("all_images", PixelBatches, replace(views, masks=masks + 1), 64, "single_image", object_fraction=0.25)
    refused("the masks have none", PixelBatches, replace(views, masks=masks), 64, "all_images", object_fraction=0.25)


def test_every_view_has_its_own_usable_pixels(views, masked):
    size = HEIGHT * WIDTH
    own = torch.arange(NUM_VIEWS)[:, None]
    for some in (views, masked):
        drawn = PixelBatches(some, 4, "all_images").of_each_view(40, 3)
        assert drawn.shape == (NUM_VIEWS, 40)
        assert torch.equal(drawn // size, own.expand_as(drawn))
    assert masked.usable.flatten()[drawn].all()
    again, others = (PixelBatches(masked, 4, "all_images").of_each_view(40, step) for step in (3, 4))
    assert torch.equal(again, drawn)
    assert not torch.equal(others, drawn)
    usable = masked.usable.clone()
    usable[2] = False
    none = PixelBatches(replace(masked, usable=usable), 4, "all_images").of_each_view(40, 3)
    assert (none[2] == 2 * size).all()
    assert usable.flatten()[none[[v for v in range(NUM_VIEWS) if v != 2]]].all()


@pytest.mark.parametrize(("batching", "size"), [("single_image", 1), ("all_images", 30)])
def test_masks_apply_to_precropped_and_distributed_batches(masked, batching, size):
    whole = PixelBatches(masked, size, batching, seed=3, precrop_steps=20)
    for step in (*range(5), *range(20, 25)):
        batch = whole.draw(step)
        shares = [whole.for_rank(rank, size).draw(step) for rank in range(size)]
        assert torch.equal(torch.cat([share.number for share in shares]), batch.number)
        assert masked.usable.flatten()[batch.number].all()
        _, row, column = place(batch.number).unbind(-1)
        inside = (row >= 3) & (row < 9) & (column >= 4) & (column < 12)
        assert bool(inside.all()) or step >= 20


def test_masks_that_leave_too_few_pixels_are_refused(masked):
    refused(
        "batch_size=2 exceeds the 1 pixels that the mask of r_2 leaves; take a smal",
        PixelBatches,
        masked,
        2,
        "single_image",
    )
    PixelBatches(masked, 500, "all_images")
    border = torch.ones(NUM_VIEWS, HEIGHT, WIDTH, dtype=torch.bool)
    border[:, 2:10, 2:14] = False
    cropped = functools.partial(PixelBatches, replace(masked, usable=border), 2, precrop_steps=1)
    refused("exceeds the 0 pixels that the mask of r_0 leaves while precropped", cropped, batching="single_image")
    refused("the masks leave no pixel to train on while precropped", cropped, batching="all_images")


@pytest.mark.parametrize("batching", ["single_image", "all_images"])
def test_precrop_draws_from_the_middle_and_ends_on_time(views, batching):
    batches = PixelBatches(views, 40, batching, seed=0, precrop_steps=30, precrop_fraction=0.5)
    cropped = torch.cat([place(batches.draw(step).number) for step in range(30)])
    assert cropped[:, 1].unique().tolist() == list(range(3, 9))
    assert cropped[:, 2].unique().tolist() == list(range(4, 12))
    whole = torch.cat([place(batches.draw(step).number) for step in range(30, 60)])
    assert whole[:, 1].unique().tolist() == list(range(HEIGHT))
    assert whole[:, 2].unique().tolist() == list(range(WIDTH))


def test_pixels_have_the_cameras_of_the_window_from_which_they_are_drawn(views):
    batches = PixelBatches(views, 40, seed=0, precrop_steps=1)
    middle, whole = batches.draw(0).window, batches.draw(1).window
    assert (middle.width, middle.height) == (8, 6)
    assert (whole.width, whole.height) == (WIDTH, HEIGHT)
    full = views.cameras.image_rays(2).directions.reshape(HEIGHT, WIDTH, 3)
    torch.testing.assert_close(middle.image_rays(2).directions.reshape(6, 8, 3), full[3:9, 4:12])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 193}, "batch_size=193 exceeds the 16x12 pixels"),
        ({"batch_size": 49, "precrop_steps": 1}, "batch_size=49 exceeds the 8x6 pixels"),
        ({"batch_size": 1, "precrop_steps": 1, "precrop_fraction": 2.0}, "central crop of 2.0"),
    ],
)
def test_option_out_of_range_is_refused(views, options, message):
    refused(message, PixelBatches, views, batching="single_image", **options)


def test_batches_hold_all_polylines_of_their_rays(views):
    sampler = Snell(branches="all")
    towards = replace(views.cameras, camera_to_world=views.cameras.camera_to_world.clone())
    towards.camera_to_world[..., 3] = 3 * towards.camera_to_world[..., 2]  # all look at the ball
    views = replace(views, cameras=towards)
    batches = PixelBatches(views, 60, "all_images", seed=1)
    model = RefractiveModel(replace(example_components(), medium=Ball(), path_sampler=sampler))
    batch = RayTracer(model, Subdivision(2, 8.0)).trace(batches.draw(3))
    assert 60 < len(batch.rays) < 4 * 60
    assert batch.path.num_rays == len(batch.rays)
    again = sampler(batch.rays, Ball())
    assert len(again.ray) > 1.5 * len(batch.rays)
    for name in ("ray", "exit_directions", "throughput"):
        torch.testing.assert_close(getattr(batch.path, name), getattr(again, name))


def test_batches_made_ahead_do_not_depend_on_the_default_type(views):
    """Lightning sets it for each step of `trainer.precision=64-true`, while a thread makes the next batch."""
    model = RefractiveModel(replace(example_components(), medium=Ball(), path_sampler=Snell())).double()
    batches = PixelBatches(views, 60, "all_images", 1).to("cpu", torch.float64)
    tracer = RayTracer(model, Subdivision(2, 0.0))
    expected = tracer.trace(batches.draw(0))
    torch.set_default_dtype(torch.float64)
    try:
        batch = tracer.trace(batches.draw(0))
    finally:
        torch.set_default_dtype(torch.float32)
    assert len(batch.rays) == 4 * 60, "all pixels are divided"
    assert batch.rays.directions.dtype == batch.path.positions.dtype == torch.float64
    assert torch.equal(batch.rays.directions, expected.rays.directions)
    assert torch.equal(batch.path.positions, expected.path.positions)
