"""Cameras of views that were not trained on, refined on the left halves of their photographs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.camera.refined import RefinedCamera
from nerfro.cameras import Cameras
from nerfro.data.base import Views
from nerfro.data.pixel_store import PixelStore
from nerfro.models.base import NerfModel
from nerfro.pixel_parts import pixel_rays

_NUM_PIXELS = 2048  # of a step
# Pixels of a step at the start; it falls to a hundredth.
_RATE = 0.05


def refine_on_left(model: NerfModel, views: Views, gains: Float[Tensor, "V 3"], steps: int) -> Cameras:
    """The cameras, each moved until the fixed scene looks like the left half of its photograph."""
    cameras, device = views.cameras.to(model.device), model.device
    part = RefinedCamera(hold_world=False).to(device)
    part.begin(cameras)
    photographs = PixelStore(views.images).to(device)
    gains, generator = gains.to(device), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(part.parameters(), lr=_RATE)
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    was_training = model.training
    model.eval()
    try:
        for step in range(steps):
            rows = torch.randint(len(views) * cameras.height, (_NUM_PIXELS,), generator=generator)
            columns = torch.randint(cameras.width // 2, (_NUM_PIXELS,), generator=generator)
            pixels = (rows * cameras.width + columns).to(device)
            view = pixels // (cameras.height * cameras.width)
            with torch.enable_grad():
                rays = part(pixel_rays(cameras, pixels), view)
                traced = model.path_sampler(rays.detach(), model.medium)
                path = model.medium.tinted(model.refined(traced, rays))
                radiance = model.render_path(path)[-1].rgb * gains[view]
                loss = mse_loss(*model.difference(radiance, photographs[pixels]))
            optimizer.zero_grad()
            loss.backward()
            optimizer.param_groups[0]["lr"] = _RATE * 0.01 ** (step / steps)
            optimizer.step()
    finally:
        model.train(was_training)
        for parameter in learning:
            parameter.requires_grad_(True)
    return part.believed(cameras).to(views.cameras.device)
