"""Rendering one view, with more than one ray where a pixel's centre does not stand for the pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from omegaconf import DictConfig

from nerfro.allowed import NotNegative, Positive, Side, checked
from nerfro.cameras import Cameras
from nerfro.models.base import NerfModel, RenderedRays
from nerfro.pixel_parts import contrast, divergence, part_rays, rays_beside


@checked("supersampling")
@dataclass(frozen=True)
class Supersampling:
    """How many rays a pixel is given."""

    side: Side = 1  # rays in each direction; a chosen pixel costs side^2 more rays
    # Pixels are chosen whose ray leaves so many pixel angles or more (`pixel_parts.divergence`) from the one beside it.
    divergence: NotNegative = 0.0
    # And pixels whose colour differs from that of a neighbour by so much (sRGB): fine texture, edges of things inside.
    contrast: Positive | None = None

    @classmethod
    def of(cls, evaluation: DictConfig) -> Supersampling:
        """What `evaluation` of a run asks for; runs of former releases do not name `contrast`."""
        return cls(evaluation.supersample, evaluation.divergence, evaluation.get("contrast"))


def render_view(model: NerfModel, cameras: Cameras, view: int, supersampling: Supersampling) -> RenderedRays:
    """Render all pixels of one view, row by row; radiance is the mean over the rays of supersampled pixels."""
    rendered = model.render(cameras.image_rays(view))
    if supersampling.side == 1:
        return rendered
    size = cameras.height * cameras.width
    pixels = torch.arange(view * size, (view + 1) * size, device=cameras.device)
    with torch.inference_mode():
        beside = [model.exit_directions(rays_beside(cameras, some)) for some in pixels.split(model.chunk_size)]
    exits = torch.cat(beside)
    angles = divergence(cameras, pixels, rendered.exit_directions, exits)
    divided = angles >= supersampling.divergence
    if supersampling.contrast is not None:
        shown = model.photographed(rendered.radiance)
        divided |= contrast(lambda some: shown[some - pixels[0]], cameras, pixels) >= supersampling.contrast
    chosen = divided.nonzero()[:, 0]
    if len(chosen) == 0:
        return rendered
    radiance, num_parts = rendered.radiance.clone(), supersampling.side**2
    for some in chosen.split(max(1, model.chunk_size // num_parts)):
        parts = model.render(part_rays(cameras, pixels[some], supersampling.side)).radiance
        radiance[some] = parts.view(-1, num_parts, 3).mean(1)
    return replace(rendered, radiance=radiance)
