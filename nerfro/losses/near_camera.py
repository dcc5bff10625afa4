"""Penalty for density close to the cameras."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "near_camera")
class NearCamera(Loss):
    """Penalize density between the cameras and the content, with a weight that decreases with the distance.

    The weight of a sample at arc length s is max(1 - s / d, 0), where d is the distance of the camera from the centre
    of the space of the run. Few rays cross the space close to a camera. Floating density in this space contradicts no
    photograph, but hides the scene from other directions. The loss is similar to the occlusion loss of FreeNeRF (Yang
    et al. 2023, Eqn. 8).
    """

    weight = 1e-2
    needs_box = True

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        rendering = renderings[-1]
        path = rendering.path
        cameras = (path.positions[:, 0] - path.near[:, None] * path.directions[:, 0]).detach()
        distance = (cameras - scene.space.centre).norm(dim=-1).clamp(min=1e-6)
        closeness = (1 - rendering.samples.s / distance[:, None]).clamp(min=0)
        return batch.per_pixel(path.sum_polylines((rendering.weights * closeness).sum(-1))).mean()
