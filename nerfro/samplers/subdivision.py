"""Rays through pixels, and the subdivision of pixels that one ray does not represent.

Axis Q: pixels. Pixels are numbered view * H * W + row * W + column.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.rays import Rays
from nerfro.core.types import Path
from nerfro.registry.allowed import Natural, NotNegative, Positive, Side, validated

Trace = Callable[[Rays, Int[Tensor, "R"]], Path]  # traces rays of views
TraceExits = Callable[[Rays, Int[Tensor, "R"]], Float[Tensor, "R 3"]]  # traces their exit directions alone

# Offset to the neighbouring ray along both axes, in pixels: one pixel along the diagonal, so that edges along rows and
# columns are detected equally.
_TO_NEIGHBOUR = math.sqrt(0.5)
# Smallest angle between the exit directions of neighbouring rays, in pixel angles, for which a pixel shows a mean over
# distant directions.
DIVERGENT = 8.0


@validated("subdivision")
@dataclass
class Subdivision:
    """Selection of pixels with several rays, and the number of rays.

    A pixel shows the mean radiance over a square. One ray through the centre does not represent the mean if
    neighbouring rays diverge, as at edges of the refractive object, or if the image has fine detail.

    Attributes:
        side: rays along each side of a divided pixel, which has side^2 rays; 1 divides no pixels.
        divergence: minimum angle between the exit directions of a pixel's ray and of the neighbouring ray for which
            the pixel is divided, in pixel angles 1 / fx; 0 divides all pixels.
        contrast: minimum difference of a channel (sRGB) from one of the four neighbouring pixels for which a pixel is
            divided as well; in training only for refracted rays. None disables the criterion.
        contrast_start: training step from which `contrast` applies.
    """

    side: Side = 1
    divergence: NotNegative = 0.0
    contrast: Positive | None = None
    contrast_start: Natural = 0


@dataclass
class SubdivisionChanges:
    """Attributes of a `Subdivision` that are replaced; None keeps the value of the run.

    Attributes:
        side: rays along each side of a divided pixel.
        divergence: minimum angle, in pixel angles, for which pixels are divided.
        contrast: minimum difference of a channel for which pixels are divided.
    """

    side: Side | None = None
    divergence: NotNegative | None = None
    contrast: Positive | None = None


@dataclass(frozen=True)
class PixelRays:
    """Rays through pixels, one or several for each; rays of undivided pixels come first.

    Attributes:
        rays: R rays.
        path: path of each ray; None without tracing.
        ray_pixel: pixel of each ray, as an index of the given pixels.
        part: number of the ray within the pixel.
        diverges: pixels whose neighbouring rays diverge by at least `DIVERGENT` pixel angles; none if no pixel may be
            divided.
    """

    rays: Rays
    path: Path | None
    ray_pixel: Int[Tensor, "R"]
    part: Int[Tensor, "R"]
    diverges: Bool[Tensor, "Q"]


def subdivide(
    cameras: Cameras,
    pixels: Int[Tensor, "Q"],
    subdivision: Subdivision,
    trace: Trace | None,
    trace_exits: TraceExits | None,
    contrasts: Callable[[Int[Tensor, " subset"]], Float[Tensor, " subset"]] | None,
) -> PixelRays:
    """Trace rays through pixels, several for pixels that one ray does not represent.

    Args:
        cameras: cameras of all views.
        pixels: numbers of the pixels.
        subdivision: criteria for the division of pixels.
        trace: traces rays, given the view of each ray; None disables tracing and division.
        trace_exits: traces the exit direction of each ray's main polyline; None uses `trace`.
        contrasts: contrast of the pixels in given rows of `pixels`; None disables the criterion.
    """
    view, num_parts = cameras.view_of(pixels), subdivision.side**2
    rays = pixel_rays(cameras, pixels)
    path = None if trace is None else trace(rays, view)
    if trace is None or path is None or num_parts == 1:
        every = torch.arange(len(pixels), device=pixels.device)
        return PixelRays(rays, path, every, torch.zeros_like(every), torch.zeros_like(every, dtype=torch.bool))
    trace_exits = trace_exits or (lambda rays, view: main_exits(trace(rays, view)))
    exits, neighbours = main_exits(path), trace_exits(neighbour_rays(cameras, pixels), view)
    angle = divergence(cameras, pixels, exits, neighbours)
    divided = angle >= subdivision.divergence
    if contrasts is not None and subdivision.contrast is not None:
        rows = (path.main_polyline(path.refracted) & ~divided).nonzero()[:, 0]
        divided = divided.index_put((rows,), contrasts(rows) >= subdivision.contrast)
    whole, parted = (~divided).nonzero()[:, 0], divided.nonzero()[:, 0]
    parts, pixel = part_rays(cameras, pixels[parted], subdivision.side), parted.repeat_interleave(num_parts)
    part = torch.arange(num_parts, device=pixels.device).repeat(len(parted))
    return PixelRays(
        rays=Rays.joined([rays[whole], parts]),
        path=Path.joined([path.select_rays(whole), trace(parts, view[pixel])]),
        ray_pixel=torch.cat([whole, pixel]),
        part=torch.cat([torch.zeros_like(whole), part]),
        diverges=angle >= DIVERGENT,
    )


def pixel_rays(
    cameras: Cameras, pixels: Int[Tensor, "R"], place: Float[Tensor, "R 2"] | Float[Tensor, "2"] | None = None
) -> Rays:
    """Make rays through a position (x, y) of pixels, see `Cameras.rays`, by default the centres."""
    width, height = cameras.width, cameras.height
    return cameras.rays(cameras.view_of(pixels), pixels // width % height, pixels % width, place)


def part_rays(cameras: Cameras, pixels: Int[Tensor, "Q"], side: int) -> Rays:
    """Make rays through the centres of the K = side x side equal parts of each pixel."""
    ticks = torch.arange(side, device=pixels.device)
    corners = torch.cartesian_prod(ticks, ticks).view(-1, 2)
    places = (corners + 0.5) / side
    return pixel_rays(cameras, pixels.repeat_interleave(side**2), places.repeat(len(pixels), 1))


def neighbour_rays(cameras: Cameras, pixels: Int[Tensor, "R"]) -> Rays:
    """Make the neighbours of the rays of `pixel_rays`, one pixel along the diagonal."""
    return pixel_rays(cameras, pixels, torch.full((2,), 0.5 + _TO_NEIGHBOUR, device=pixels.device))


def main_exits(path: Path) -> Float[Tensor, "R 3"]:
    """Return the exit direction of the main polyline of each ray."""
    return path.main_polyline(path.exit_directions)


def contrast(
    colours: Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]], cameras: Cameras, pixels: Int[Tensor, "R"]
) -> Float[Tensor, "R"]:
    """Compute the largest difference of a channel between pixels and their four neighbours."""
    height, width = cameras.height, cameras.width
    row, column = pixels // width % height, pixels % width
    own = colours(pixels)
    largest = torch.zeros_like(own[:, 0])
    for step, exists in ((-1, column > 0), (1, column < width - 1), (-width, row > 0), (width, row < height - 1)):
        other = colours(torch.where(exists, pixels + step, pixels))
        largest = torch.maximum(largest, (other - own).abs().amax(-1))
    return largest


def divergence(
    cameras: Cameras, pixels: Int[Tensor, "R"], exits: Float[Tensor, "R 3"], neighbours: Float[Tensor, "R 3"]
) -> Float[Tensor, "R"]:
    """Compute the angle between the exit directions of rays and of their neighbours, in pixel angles 1 / fx.

    Straight rays diverge by at most 1. A pixel of large divergence shows a mean over distant directions; training the
    background with the central ray alone would cause speckle.
    """
    chord = torch.linalg.vector_norm(exits - neighbours, dim=-1)
    return 2 * torch.asin((0.5 * chord).clamp(max=1)) * cameras.fx[cameras.view_of(pixels)]
