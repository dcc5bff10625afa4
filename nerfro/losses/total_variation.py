"""Total-variation loss of the background."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, Exits, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene

# Random pairs of directions for each step.
_NUM_PAIRS = 1024
# Angle between two directions, in texels or details of the background.
_NUM_DETAILS = 2


@register("loss", "total_variation")
class TotalVariation(Loss):
    """Penalize absolute differences of the background colour between random directions at a fixed angle.

    Unlike `smoothness`, which squares differences, the loss does not prefer many small steps to one edge (Rudin, Osher
    and Fatemi, 1992), and covers the whole sphere, including directions in which no training ray leaves.

    Args:
        angle: angle between the two directions in degrees. None takes two texels of the finest level of the background
            that gradient descent learns.
    """

    weight = 1e-3

    def __init__(self, angle: Annotated[float, Gt(0), Lt(90)] | None = None) -> None:
        super().__init__()
        self.angle = angle

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        index = torch.arange(_NUM_PAIRS, device=batch.rgb.device)
        numbers = batch.draws.uniform(index, 3, "total variation")
        angle = _NUM_DETAILS * scene.background.detail if self.angle is None else self.angle
        first, second = direction_pairs(numbers, math.radians(angle))
        rgb = scene.colour_space.to_srgb(scene.background(Exits(torch.cat([first, second]))))
        return (rgb[_NUM_PAIRS:] - rgb[:_NUM_PAIRS]).abs().mean()


def direction_pairs(
    numbers: Float[Tensor, "directions 3"], angle: float
) -> tuple[Float[Tensor, "directions 3"], Float[Tensor, "directions 3"]]:
    """Map uniform numbers in [0, 1) to pairs of unit directions that are `angle` radians apart.

    The first direction is uniform on the sphere, and the second is uniform on the circle around the first.
    """
    z = 2 * numbers[:, 0] - 1
    azimuth, turn = (2 * math.pi * numbers[:, 1:]).unbind(-1)
    cosine, sine, radius = azimuth.cos(), azimuth.sin(), (1 - z.square()).clamp(min=0).sqrt()
    first = torch.stack([radius * cosine, radius * sine, z], -1)
    # Unit vectors along the meridian and along the parallel of the first direction.
    south, east = torch.stack([z * cosine, z * sine, -radius], -1), torch.stack([-sine, cosine, 0 * z], -1)
    tangent = turn.cos()[:, None] * south + turn.sin()[:, None] * east
    return first, math.cos(angle) * first + math.sin(angle) * tangent
