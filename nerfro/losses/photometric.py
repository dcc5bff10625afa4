"""Photometric loss."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.core.types import Batch, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.allowed import NotNegative
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "photometric")
class Photometric(Loss):
    """Compute the mean squared colour error of all sampling levels (paper, Eqn. 7).

    The mean is over pixels and channels, as in the authors' code; the norm in the paper is three times larger.

    Args:
        coarse: factor of the errors of coarser levels; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(self, coarse: NotNegative = 1.0) -> None:
        super().__init__()
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        value = batch.rgb.new_zeros(())
        for rendering, factor in zip(renderings, [self.coarse] * (len(renderings) - 1) + [1.0], strict=True):
            radiance = batch.per_pixel(rendering.radiance)
            value = value + factor * mse_loss(*scene.colour_space.prediction_and_target(radiance, batch.rgb))
        return value
