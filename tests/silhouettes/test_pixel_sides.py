"""Outlines of binary masks, determined by the sides of pixels."""

import numpy as np
import pytest
import torch
import trimesh

from nerfro.silhouettes.moving_mesh import MovingMesh
from nerfro.silhouettes.rims import Rims, by_pixel_sides, find_rims, outlines_of
from nerfro.silhouettes.silhouette_fit import fit_surface
from nerfro.silhouettes.silhouettes import is_antialiased
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.exact_silhouettes import cameras_around, hull, photographed, photographed_softly

RADIUS, MIDDLE = 0.7, np.array([0.11, 0.07, -0.05])


def ball(radius: float = RADIUS) -> trimesh.Trimesh:
    """Beside the point that the cameras look at: each view sees another disc."""
    return trimesh.creation.icosphere(5, radius).apply_translation(MIDDLE)


def seen(radius: float, silhouettes: Silhouettes) -> tuple[Rims, Rims]:
    """Rims of a ball of another radius, as read off the outlines, and by the sides of pixels."""
    made = ball(radius)
    surface = MovingMesh(np.asarray(made.faces)).geometry(np.asarray(made.vertices))
    rims = find_rims(surface, silhouettes, outlines_of(silhouettes))
    return rims, by_pixel_sides(rims, silhouettes, 0.16)


def pixel(size: int) -> float:
    """Width of a pixel at the rims of a body in the middle, world units."""
    return 3.94 / 1.4 / size


def mean(rims: Rims) -> float:
    """Misfit, pixels."""
    return float(np.average(rims.misfit / rims.width, weights=rims.weight))


@pytest.fixture(scope="module")
def silhouettes() -> Silhouettes:
    return photographed(ball(), cameras_around(20, 96))


def test_correct_surface_is_unchanged(silhouettes: Silhouettes) -> None:
    """The outlines that are read off the masks want single rims to move by a tenth of a pixel."""
    read, sides = seen(RADIUS, silhouettes)
    moves = [np.sqrt(np.average((rims.misfit / rims.width) ** 2, weights=rims.weight)) for rims in (read, sides)]
    assert abs(mean(sides)) < 0.02
    assert moves[1] < 0.5 * moves[0]


@pytest.mark.parametrize("off", [-0.3, 0.3])
def test_displaced_surface_moves_to_the_outlines(silhouettes: Silhouettes, off: float) -> None:
    """In a few steps."""
    width = pixel(silhouettes.cameras.width)
    radius = RADIUS + off * width
    for _ in range(6):
        radius += width * mean(seen(radius, silhouettes)[1])
    assert abs(radius - RADIUS) / width < 0.03


@pytest.mark.slow
def test_fitted_surface_has_the_size_of_the_body() -> None:
    """It is 0.09 pixels too small if the sides of pixels are not looked at."""
    size, axes = 48, np.array([0.8, 0.6, 0.45])
    body = trimesh.creation.icosphere(5)
    body.vertices = axes * body.vertices + MIDDLE
    silhouettes = photographed(body, cameras_around(20, size))
    fitted = fit_surface(hull(silhouettes, 24), silhouettes)
    beyond = axes.mean() * (np.linalg.norm((fitted.vertices - MIDDLE) / axes, axis=1) - 1)
    assert abs(beyond.mean()) < 0.05 * pixel(size)


def test_binary_masks_are_distinguished_from_coverage_masks(silhouettes: Silhouettes) -> None:
    soft = photographed_softly(ball(), silhouettes.cameras, 4)
    nearly = Silhouettes.of(silhouettes.cameras, (silhouettes.masks + 0.01).clamp(max=1))  # as JPEG leaves them
    empty = torch.zeros(1, 8, 8)
    assert is_antialiased(soft.masks.numpy(), soft.distances.numpy())
    for masks in (silhouettes, nearly):
        assert not is_antialiased(masks.masks.numpy(), masks.distances.numpy())
    assert not is_antialiased(empty.numpy(), Silhouettes.of(silhouettes.cameras.select([0]), empty).distances.numpy())
