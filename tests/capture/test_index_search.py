"""The index of a known surface, from photographs of it under a sky in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfro.capture import index_search
from nerfro.capture.index_search import Estimate, IndexSettings, find_indices
from nerfro.capture.surroundings import divide_pixels, learn_surroundings, robust_scale
from nerfro.data.base import Views
from tests.ball_photographs import INNER, NUM_VIEWS, SIZE, cameras, mesh, photographs, solid
from tests.conftest import refused


def search(views: Views, num_bodies: int = 1, inner: float = INNER) -> Estimate:
    beside, through = divide_pixels(views, mesh())
    return find_indices(solid([1.5] * num_bodies, inner), through, learn_surroundings(beside, mesh(), False))


@pytest.mark.parametrize(("ior", "is_material"), [(1.2, False), (1.5, True)])
def test_index_search_recovers_the_index_of_a_ball(ior: float, is_material: bool) -> None:
    """No liquid or solid has an index of 1.2, which would be that of an opaque or hollow object."""
    found = search(photographs([ior]))
    assert found.values[0] == pytest.approx(ior, rel=0.005)
    assert 0 < found.standard_errors[0] < 0.01 * ior
    assert (not found.doubts) == is_material


def test_no_grid_is_evaluated_twice_at_an_end_of_the_range() -> None:
    grids: list[tuple[int, bytes]] = []

    class Falling(index_search._Search):
        """Errors that decrease towards an index below the range."""

        def __init__(self) -> None:
            self.settings = IndexSettings()

        def errors(self, candidates: np.ndarray, num_pixels: int, common: bool) -> tuple[np.ndarray, np.ndarray]:
            grids.append((num_pixels, candidates.tobytes()))
            return (candidates - 0.5) ** 2, np.ones(1)

    search = Falling()
    values, _ = index_search._refine_minimum(search, search.settings.plans[0], np.array([1.02]))
    assert values.tolist() == [1.0]
    assert len(set(grids)) == len(grids)


@pytest.mark.parametrize(("num_views", "num_seen"), [(1, 1), (8, 4)])
def test_too_few_views_have_an_infinite_standard_error(num_views: int, num_seen: int) -> None:
    """Views without pixels of the object contribute nothing."""
    views = photographs([1.5]).select(list(range(num_views)))
    beside, through = divide_pixels(views, mesh())
    through = through[through.view < num_seen]
    found = find_indices(solid([1.5]), through, learn_surroundings(beside, mesh(), False))
    assert found.standard_errors.tolist() == [math.inf]
    assert found.written_errors == [None]
    assert any(f"{num_seen} views are too few" in doubt for doubt in found.doubts)
    assert not any("inf" in doubt for doubt in found.doubts)


@pytest.mark.slow
def test_index_search_recovers_water_in_a_glass_wall() -> None:
    found = search(photographs([1.5, 1.33]), 2)
    assert found.values.tolist() == pytest.approx([1.5, 1.33], rel=0.01)
    assert not found.doubts


@pytest.mark.slow
def test_correlated_indices_are_reported_as_uncertain() -> None:
    """Every ray crosses both bodies: 1.69 and 1.375 look nearly the same, and do in such small photographs."""
    found = search(photographs([1.5, 1.33], inner=0.5), 2, 0.5)
    assert (abs(found.values - [1.5, 1.33]) < 3 * found.standard_errors).all()
    assert found.standard_errors[0] > 3 * found.standard_errors[1] > 0
    assert any("the views do not agree" in doubt for doubt in found.doubts)


@pytest.mark.slow
def test_opaque_ball_has_no_index() -> None:
    found = search(photographs([1.5], opaque=True))
    assert any("may be opaque" in doubt for doubt in found.doubts)


def test_masks_define_the_pixels_of_the_object() -> None:
    views = photographs([1.5])
    masks = torch.zeros(NUM_VIEWS, SIZE, SIZE)
    masks[:, 10:20, 10:20] = 1
    beside, through = divide_pixels(replace(views, masks=masks), mesh())
    assert len(through) == NUM_VIEWS * 8 * 8
    assert len(beside) == NUM_VIEWS * (SIZE * SIZE - 12 * 12)
    refused("0 inside its silhouette", divide_pixels, replace(views, masks=0 * masks), mesh())


def test_masks_that_nearly_reach_black_and_white_select_the_same_pixels() -> None:
    """Mattes and JPEG files have values such as 1/255 and 254/255."""
    views, masks = photographs([1.5]), torch.zeros(NUM_VIEWS, SIZE, SIZE)
    masks[:, 10:20, 10:20] = 1
    exact, noisy = (divide_pixels(replace(views, masks=m), mesh()) for m in (masks, masks.clamp(2 / 255, 253 / 255)))
    for ours, theirs in zip(exact, noisy, strict=True):
        assert torch.equal(ours.index, theirs.index)


def test_surroundings_that_only_a_validation_view_shows_are_learned() -> None:
    views = photographs([1.5]).select(list(range(8)))
    beside, _ = divide_pixels(views, mesh())
    beside = beside[beside.view == 7]
    assert learn_surroundings(beside, mesh(), False).unexplained < 0.5
    alone = learn_surroundings(beside[torch.arange(1)], mesh(), False)
    assert math.isfinite(alone.unexplained)
    assert 0 < robust_scale(alone) < 1


def test_large_photographs_are_averaged_in_linear_light() -> None:
    taken = cameras()
    big = replace(taken, width=10 * SIZE, height=10 * SIZE, fx=10 * taken.fx, fy=10 * taken.fy, cx=10 * taken.cx,
                  cy=10 * taken.cy)  # fmt: skip
    checker = (torch.arange(10 * SIZE)[:, None] + torch.arange(10 * SIZE)) % 2
    images = checker.float()[None, ..., None].expand(NUM_VIEWS, -1, -1, 3)
    beside, _ = divide_pixels(Views(big, images, None, [""] * NUM_VIEWS), mesh())
    assert beside.cameras.width == 5 * SIZE
    torch.testing.assert_close(beside.radiance, torch.full_like(beside.radiance, 0.5))
    # The same directions: the middle of a block of two is the corner between its pixels.
    assert math.isclose(float(beside.cameras.fx[0]), 5 * float(taken.fx[0]), rel_tol=1e-6)
