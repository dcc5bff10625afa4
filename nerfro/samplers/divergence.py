"""Pixels for which the ray through their centre does not stand: where neighbouring rays leave in other directions."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.data.cameras import Cameras
from nerfro.errors import NerfroError
from nerfro.types import Path, Rays


def exit_divergence(directions: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Largest angle in radians between a pixel's exit direction and those of its four neighbours."""
    padded = F.pad(directions.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    neighbours = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    chords = torch.stack([(directions - other).norm(dim=-1) for other in neighbours]).amax(0)
    return 2 * torch.asin((0.5 * chords).clamp(max=1))


def steady_pixels(
    trace: Callable[[Int[Tensor, "R"], Rays], Path], cameras: Cameras, max_divergence: float
) -> Bool[Tensor, "V H W"]:
    """Pixels whose exit direction differs from every neighbour's by less than a limit.

    The others lie on the object's rim and edges. Their colour is an average over directions far apart, which a ray
    through the centre would teach to one of them, as speckle.

    Args:
        trace: paths of rays, given the rays' identity `view * H * W + row * W + column`.
        cameras: of the images.
        max_divergence: limit in pixel angles, 1 / fx.

    Raises:
        NerfroError: the limit is not positive.
    """
    if not max_divergence > 0:
        raise NerfroError(f"batches.max_divergence={max_divergence} leaves no pixel; take more than 1, or null for all")
    size = cameras.height * cameras.width
    steady = []
    for view in range(len(cameras)):
        index = torch.arange(view * size, (view + 1) * size, device=cameras.device)
        directions = trace(index, cameras.image_rays(view)).exit_directions
        limit = max_divergence / float(cameras.fx[view])
        steady.append(exit_divergence(directions.view(cameras.height, cameras.width, 3)) < limit)
    return torch.stack(steady)
