"""Rendering one view, with more than one ray where a pixel's centre does not stand for the pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from nerfro.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.models.base import NerfModel, RenderedRays
from nerfro.pixel_parts import PixelParts
from nerfro.samplers.divergence import exit_divergence


@dataclass(frozen=True)
class Supersampling:
    """How many rays a pixel is given.

    Attributes:
        side: rays in each direction; a chosen pixel costs side^2 more rays.
        divergence: pixels are chosen whose exit direction differs from a neighbour's by more than this many pixel
            angles; 0 chooses all.
    """

    side: int = 1
    divergence: float = 0.0

    def __post_init__(self) -> None:
        if self.side < 1 or self.divergence < 0:
            raise NerfroError(
                f"supersampling side={self.side} divergence={self.divergence}; take 1 or more, and 0 or more"
            )


def render_view(model: NerfModel, cameras: Cameras, view: int, supersampling: Supersampling) -> RenderedRays:
    """Render all pixels of one view, row by row; radiance is the mean over the rays of supersampled pixels.

    Args:
        model: the trained model.
        cameras: on the model's device.
        view: which of them.
        supersampling: rays per pixel.
    """
    rendered = model.render(cameras.image_rays(view))
    if supersampling.side == 1:
        return rendered
    diverging = exit_divergence(rendered.exit_directions.view(cameras.height, cameras.width, 3))
    pixel_angle = 1 / float(cameras.fx[view])
    chosen = (diverging >= supersampling.divergence * pixel_angle).flatten().nonzero()[:, 0]
    if len(chosen) == 0:
        return rendered
    parts = PixelParts(cameras, supersampling.side, view * cameras.height * cameras.width + chosen)
    total = torch.zeros_like(rendered.radiance[chosen])
    for part in range(parts.rays_per_pixel):
        rays = parts.rays(torch.arange(part, len(parts), parts.rays_per_pixel, device=cameras.device))
        total += model.render(rays).radiance
    radiance = rendered.radiance.clone()
    radiance[chosen] = total / parts.rays_per_pixel
    return replace(rendered, radiance=radiance)
