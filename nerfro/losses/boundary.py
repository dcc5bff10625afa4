"""The boundary regulariser."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.distributed import rank_and_size, sum_over_processes
from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering

# Rays count whose transmittance at the end is above this, as in the paper.
_MIN_TRANSMITTANCE = 0.5


@register("loss", "boundary")
class BoundaryRegulariser(Loss):
    """Where most light passes, the boundary alone shall explain the pixel: |T C'(d) - C|, T > 1/2 (Eqn. lossBD).

    The boundary's colour is held fixed, so only the finest level's density learns: it clears fog from the surface.
    Channels are summed and the sum over rays is divided by their number plus one, as in the authors' code.

    Args:
        refracted_only: count only rays that meet the medium.
    """

    weight, start = 0.025, 2500

    def __init__(self, refracted_only: bool = False) -> None:
        super().__init__()
        self.refracted_only = refracted_only

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        fine = renderings[-1]
        path = fine.path
        counts = batch.per_pixel(path.per_ray(fine.transmittance.detach())) > _MIN_TRANSMITTANCE
        if self.refracted_only:
            counts = counts & (batch.per_pixel(path.first_of_ray(path.refracted).to(fine.rgb)) > 0.5)
        background = path.per_ray(fine.transmittance[:, None] * fine.boundary_rgb.detach())
        shown = scene.colour_space.to_srgb(batch.per_pixel(background))
        error = (shown - batch.rgb).abs().sum(-1)
        # Processes average their gradients: each brings its sum as often as there are processes.
        return (error * counts).sum() * rank_and_size()[1] / (sum_over_processes(counts.sum()) + 1)
