"""Rendering of one view, with several rays in pixels whose central ray is not representative."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import ViewMaps
from nerfro.rendering import RenderedRays, Renderer
from nerfro.samplers.subdivision import Subdivision, contrast, divergence, neighbour_rays, part_rays


def render_view(renderer: Renderer, cameras: Cameras, view: int, subdivision: Subdivision) -> RenderedRays:
    """Render all pixels of one view, row by row; radiance is the mean over the rays of divided pixels."""
    rendered = renderer.render(cameras.image_rays(view))
    straight = not renderer.path_sampler.needs_medium  # such rays diverge by at most 1
    if subdivision.side == 1 or (straight and subdivision.divergence > 1 and subdivision.contrast is None):
        return rendered
    size = cameras.height * cameras.width
    pixels = torch.arange(view * size, (view + 1) * size, device=cameras.device)
    with torch.inference_mode():
        neighbours = renderer.map_chunks(
            lambda rows: renderer.exit_directions(neighbour_rays(cameras, pixels[rows])), pixels, renderer.chunk_size
        )
    angles = divergence(cameras, pixels, rendered.exit_directions, torch.cat(neighbours))
    divided = angles >= subdivision.divergence
    if subdivision.contrast is not None:
        shown = renderer.scene.colour_space.to_display(rendered.radiance)
        divided |= contrast(lambda some: shown[some - pixels[0]], cameras, pixels) >= subdivision.contrast
    pixels_to_divide = divided.nonzero()[:, 0]
    if len(pixels_to_divide) == 0:
        return rendered
    radiance, num_parts = rendered.radiance.clone(), subdivision.side**2

    def mean_of_parts(rows: slice) -> Tensor:
        parts = part_rays(cameras, pixels[pixels_to_divide[rows]], subdivision.side)
        return renderer.render(parts).radiance.view(-1, num_parts, 3).mean(1)

    size = max(1, renderer.chunk_size // num_parts)
    radiance[pixels_to_divide] = torch.cat(renderer.map_chunks(mean_of_parts, pixels_to_divide, size))
    return replace(rendered, radiance=radiance)


def maps_of(views: Views, view: int, rendered: RenderedRays) -> ViewMaps:
    """Return the maps of a view of the data and of its rendering, on the CPU."""
    size = views.cameras.height, views.cameras.width
    names = "depth", "opacity", "exit_directions", "normals", "refracted"
    of_model = {name: getattr(rendered, name).float().cpu().view(*size, -1) for name in names}
    return ViewMaps({name: values[view] for name, values in views.maps.items()}, of_model)
