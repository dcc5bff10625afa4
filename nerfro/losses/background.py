"""Background regularizer of the paper."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.core.distributed import rank_and_size, sum_over_processes
from nerfro.core.types import Batch, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "background")
class BackgroundRegularizer(Loss):
    """Penalize |T C'(d) - C| where the final transmittance T is above 1/2 (paper, Eqn. 8).

    The background should explain such pixels without the field, so the loss removes fog in front of the surface. Only
    the density of the finest level learns, because the colour of the background is detached. Channels are summed, and
    the sum over pixels is divided by the number of counted pixels plus one, as in the authors' code.

    Args:
        refracted_only: whether to count only rays that meet the medium.
    """

    weight, start = 0.025, 2500

    def __init__(self, refracted_only: bool = False) -> None:
        super().__init__()
        self.refracted_only = refracted_only

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        fine = renderings[-1]
        path = fine.path
        # Pixels count if their final transmittance is above one half, as in the paper.
        counted = batch.per_pixel(path.sum_polylines(fine.transmittance.detach())) > 0.5
        if self.refracted_only:
            counted = counted & (batch.per_pixel(path.main_polyline(path.refracted).to(fine.radiance)) > 0.5)
        background = path.sum_polylines(fine.transmittance[:, None] * fine.background_radiance.detach())
        predicted, target = scene.colour_space.prediction_and_target(batch.per_pixel(background), batch.rgb)
        error = (predicted - target).abs().sum(-1)
        # Gradients are averaged over processes, so each process multiplies its sum by the number of processes.
        return (error * counted).sum() * rank_and_size()[1] / (sum_over_processes(counted.sum()) + 1)
