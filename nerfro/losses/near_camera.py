"""Penalty for density close to the cameras."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, Rendering
from nerfro.geometry.box import corners_of_box
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "near_camera")
class NearCamera(Loss):
    """Penalize density between the cameras and the content, with a weight that decreases with the distance.

    The weight of a sample at arc length s is max(1 - s / d, 0), where d is the distance of the camera from the centre
    of the content's box. Few rays cross the space close to a camera. Floating density in this space contradicts no
    photograph, but hides the scene from other directions. The loss is similar to the occlusion loss of FreeNeRF (Yang
    et al. 2023, Eqn. 8).

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
        cameras = (path.positions[:, 0] - path.near[:, None] * path.directions[:, 0]).detach()
        distance = (cameras - self.middle).norm(dim=-1).clamp(min=1e-6)
        closeness = (1 - rendering.samples.s / distance[:, None]).clamp(min=0)
        return batch.per_pixel(path.sum_polylines((rendering.weights * closeness).sum(-1))).mean()
