"""Light that stops close before a camera."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.allowed import corners_of_box
from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering


@register("loss", "nearby")
class Nearby(Loss):
    """Mean share of light that stops between the cameras and what they look at, more the closer to the camera.

    What stops at arc length s counts 1 - s / d, where d is the camera's distance from the middle of the content's box;
    beyond d it counts nothing. Few rays cross what is close before a camera, so a cloud there that hides all else from
    other places contradicts no photograph (compare the occlusion loss of FreeNeRF, Yang et al. 2023, Eqn. 8).

    Args:
        box_min, box_max: corners of the content's box, world units.
    """

    middle: Float[Tensor, "3"]
    weight = 1e-2

    def __init__(
        self,
        box_min: Sequence[float] = (-1.0, -1.0, -1.0),
        box_max: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        middle = torch.from_numpy(corners_of_box(box_min, box_max)).float().mean(0)
        self.register_buffer("middle", middle, persistent=False)

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path = rendering.path
        distance = (path.positions[:, 0].detach() - self.middle).norm(dim=-1).clamp(min=1e-6)
        counts = (1 - rendering.samples.s / distance[:, None]).clamp(min=0)
        return batch.per_pixel(path.per_ray((rendering.weights * counts).sum(-1))).mean()
