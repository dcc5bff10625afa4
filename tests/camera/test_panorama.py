"""Photographs of a distant sky tell how cameras are turned towards each other, and the lens that they share."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.cameras import disturbed
from nerfro.cameras import Cameras
from nerfro.geometry.interpolation import misses
from nerfro.light import to_linear, to_srgb
from tests.ball_photographs import BOX, NUM_VIEWS, cameras, photographs
from tests.camera.refined_cameras import PriorInformation, RefinedCamera, align

TRUE = cameras()
PHOTOGRAPHS = photographs([1.45]).images.reshape(-1, 3)


def panorama(
    camera: RefinedCamera, given: Cameras, box: Tensor = BOX, gains: Tensor | None = None
) -> PriorInformation | None:
    def photographed(pixels: Tensor) -> Tensor:
        colours = PHOTOGRAPHS[pixels]
        view = pixels // (TRUE.height * TRUE.width)
        return colours if gains is None else to_srgb(to_linear(colours) * gains[view, None])

    camera.begin(given)
    return align(camera, given, photographed, lambda rays: misses(box, rays))


def turned(camera: RefinedCamera, given: Cameras) -> Tensor:
    """By how many degrees each camera is off, after the turn of all that fits best."""
    axes, true = (poses[..., :3].double() for poses in (camera.motions.moved(), TRUE.camera_to_world))
    u, _, vt = torch.linalg.svd((axes @ true.mT).mean(0))
    between = (u @ vt).T @ axes @ true.mT
    cosine = 0.5 * (between.diagonal(dim1=1, dim2=2).sum(-1) - 1)
    return torch.rad2deg(torch.arccos(cosine.clamp(max=1)))


@pytest.mark.parametrize("brightness", [0.0, 0.15])
def test_cameras_turn_until_their_skies_agree(brightness: float) -> None:
    """Half a degree is a quarter of a pixel. Shifts of cameras and other exposures do not disturb."""
    given = replace(TRUE, camera_to_world=disturbed(TRUE, math.radians(0.5), 0.01, 0).float())
    gains = 0.6 * torch.exp(brightness * torch.randn(NUM_VIEWS, generator=torch.Generator().manual_seed(0)))
    camera = RefinedCamera(exposure=brightness > 0)
    assert panorama(camera, given, gains=gains) is not None
    assert not bool(camera.motions.motion[:, 3:].any())
    assert float(turned(camera, given).median()) < (0.03 if brightness == 0 else 0.06)


def test_the_shared_lens_is_found_with_them() -> None:
    given = replace(TRUE, fx=1.02 * TRUE.fx, fy=1.02 * TRUE.fy)
    camera = RefinedCamera(lens=True)
    assert panorama(camera, given) is not None
    assert float(camera.estimated(given).fx[0]) == pytest.approx(float(TRUE.fx[0]), rel=2e-3)


def test_without_a_sky_nothing_is_known() -> None:
    camera = RefinedCamera()
    assert panorama(camera, TRUE, box=10 * BOX) is None
    assert not bool(camera.motions.motion.any())
