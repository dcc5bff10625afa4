"""Rays through pixels and parts of them: a pixel shows the mean over its square, which one ray may not stand for."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.rays import Rays

# From a ray to the one beside it, in pixels, along both axes: one pixel on the diagonal, where edges along rows and
# columns are seen alike.
_BESIDE = math.sqrt(0.5)


def pixel_rays(
    cameras: Cameras, pixels: Int[Tensor, "R"], place: Float[Tensor, "R 2"] | Float[Tensor, "2"] | None = None
) -> Rays:
    """Rays through a place (x, y) in [0, 1) of pixels view * H * W + row * W + column, by default their centres."""
    width, height = cameras.width, cameras.height
    return cameras.rays(pixels // (height * width), pixels // width % height, pixels % width, place)


def part_rays(
    cameras: Cameras, pixels: Int[Tensor, "P"], side: int, place: Float[Tensor, "P K 2"] | None = None
) -> Rays:
    """Rays through the K = side x side equal parts of pixels, those of each pixel together, at a place of each part."""
    ticks = torch.arange(side, device=pixels.device)
    corners = torch.cartesian_prod(ticks, ticks).view(-1, 2)
    places = (corners + (0.5 if place is None else place)) / side
    return pixel_rays(cameras, pixels.repeat_interleave(side**2), places.expand(len(pixels), -1, 2).reshape(-1, 2))


def rays_beside(cameras: Cameras, pixels: Int[Tensor, "R"], place: Float[Tensor, "R 2"] | None = None) -> Rays:
    """Rays one pixel beside those of `pixel_rays`, to see where neighbours part."""
    centre = torch.full((2,), 0.5, device=pixels.device)
    return pixel_rays(cameras, pixels, (centre if place is None else place) + _BESIDE)


def contrast(
    colours: Callable[[Int[Tensor, "R"]], Float[Tensor, "R 3"]], cameras: Cameras, pixels: Int[Tensor, "R"]
) -> Float[Tensor, "R"]:
    """Largest difference of a channel between pixels and the four around them; `colours` gives those of pixels."""
    height, width = cameras.height, cameras.width
    row, column = pixels // width % height, pixels % width
    own = colours(pixels)
    largest = torch.zeros_like(own[:, 0])
    for step, exists in ((-1, column > 0), (1, column < width - 1), (-width, row > 0), (width, row < height - 1)):
        other = colours(torch.where(exists, pixels + step, pixels))
        largest = torch.maximum(largest, (other - own).abs().amax(-1))
    return largest


def divergence(
    cameras: Cameras, pixels: Int[Tensor, "R"], exits: Float[Tensor, "R 3"], beside: Float[Tensor, "R 3"]
) -> Float[Tensor, "R"]:
    """Angle between the directions in which rays and those beside them leave, in pixel angles 1 / fx.

    Straight rays diverge by 1 or less. Where the angle is wide, on the object's rim and edges, a pixel shows a mean
    over directions far apart, which a ray through its centre would teach to one of them, as speckle.
    """
    chord = torch.linalg.vector_norm(exits - beside, dim=-1)
    view = pixels // (cameras.height * cameras.width)
    return 2 * torch.asin((0.5 * chord).clamp(max=1)) * cameras.fx[view]
