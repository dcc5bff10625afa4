"""Refinement of test cameras on the left halves of the photographs."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.camera.gauss_newton import Step, gauss_newton_step, informative_pixels
from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.rays import Rays
from nerfro.rendering import Renderer

# Pixels per view and step, and candidates drawn per pixel; the candidates with the most contrast are used.
_NUM_PIXELS, _NUM_CANDIDATES = 600, 3
# Distance of finite differences in pixels, in the first and in the last step.
_FIRST_DIFFERENCE, _LAST_DIFFERENCE = 2.0, 0.5
# Scale of the robust error in sRGB, and maximum motion of a camera in one step in pixels.
_ERROR_SCALE, _MAX_PIXELS = 0.3, 3.0


@torch.no_grad()
def refine_on_left(renderer: Renderer, views: Views, gains: Float[Tensor, "V 3"], steps: int) -> Cameras:
    """Refine each camera so that the rendering of the fixed scene matches the left half of the photograph.

    Args:
        renderer: trained model, which stays unchanged.
        views: test views.
        gains: gain of each view and channel.
        steps: number of Gauss-Newton steps.
    """
    cameras, device = views.cameras.to(renderer.scene.device), renderer.scene.device
    camera = RefinedCamera(fix_gauge=False).to(device)
    camera.begin(cameras)
    photographs, gains = PixelStore(views.images).to(device), gains.to(device)
    generator, shape = torch.Generator().manual_seed(0), (len(views), _NUM_CANDIDATES * _NUM_PIXELS)

    def photographed(pixels: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return photographs[pixels]

    def shown(rays: Rays, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return renderer.scene.colour_space.to_display(renderer.radiance(rays), gains[view])

    for step in range(steps):
        row = torch.randint(cameras.height, shape, generator=generator)
        column = torch.randint(cameras.width // 2, shape, generator=generator)
        candidates = (torch.arange(len(views))[:, None] * cameras.height + row) * cameras.width + column
        pixels = informative_pixels(candidates.to(device), _NUM_PIXELS, photographed, cameras)
        progress = step / max(steps - 1, 1)
        difference = _FIRST_DIFFERENCE * (_LAST_DIFFERENCE / _FIRST_DIFFERENCE) ** progress
        settings = Step(difference, _ERROR_SCALE, _MAX_PIXELS)
        gauss_newton_step(camera, cameras, pixels, photographed, shown, settings)
    return camera.estimated(cameras).to(views.cameras.device)
