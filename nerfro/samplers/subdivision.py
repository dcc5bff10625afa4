"""Rays through pixels, and the subdivision of pixels that one ray does not represent.

Axis Q: pixels. Pixels are numbered view * H * W + row * W + column.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.rays import Rays
from nerfro.core.types import Path
from nerfro.registry.allowed import Natural, NotNegative, Positive, Side, validated

# Position of the neighbouring ray in a pixel along both axes: one pixel along the diagonal from the centre, so that
# edges along rows and columns are detected equally.
NEIGHBOUR = 0.5 + math.sqrt(0.5)
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
    return pixel_rays(cameras, pixels, torch.full((2,), NEIGHBOUR, device=pixels.device))


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
