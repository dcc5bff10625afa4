"""Pixels for which the ray through their centre does not stand: neighbouring rays leave in other directions."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.types import Path, Rays


def exit_divergence(directions: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Largest angle in radians between a pixel's exit direction and those of its four neighbours."""
    padded = F.pad(directions.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    neighbours = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    chords = torch.stack([(directions - other).norm(dim=-1) for other in neighbours]).amax(0)
    return 2 * torch.asin((0.5 * chords).clamp(max=1))


def divergent_pixels(
    trace: Callable[[Int[Tensor, "R"], Rays], Path], cameras: Cameras, divergence: float
) -> Int[Tensor, "U"]:
    """Pixels, as `view * H * W + row * W + column`, whose exit direction differs much from a neighbour's.

    They lie on the object's rim and edges. Their colour is a mean over directions far apart, which a ray through the
    centre would teach to one of them, as speckle.

    Args:
        trace: paths of the rays through pixel centres, given the pixels and the rays.
        cameras: of the images.
        divergence: least difference, in pixel angles 1 / fx.
    """
    size = cameras.height * cameras.width
    divergent = []
    for view in range(len(cameras)):
        pixels = torch.arange(view * size, (view + 1) * size, device=cameras.device)
        directions = trace(pixels, cameras.image_rays(view)).exit_directions
        angles = exit_divergence(directions.view(cameras.height, cameras.width, 3))
        divergent.append(pixels[angles.flatten() >= divergence / float(cameras.fx[view])])
    return torch.cat(divergent)
