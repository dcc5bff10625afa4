"""The re-rendering error."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.allowed import NotNegative
from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering


@register("loss", "photometric")
class Photometric(Loss):
    """Mean squared colour error of the last level, plus that of earlier ones (paper, Eqn. lossRGB).

    The mean is over pixels and channels, as in the authors' code; the paper's norm is three times that.

    Args:
        coarse: factor of the earlier levels' errors; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(self, coarse: NotNegative = 1.0) -> None:
        super().__init__()
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        value = batch.rgb.new_zeros(())
        for rendering, factor in zip(renderings, [self.coarse] * (len(renderings) - 1) + [1.0], strict=True):
            radiance = batch.per_pixel(rendering.rgb)
            value = value + factor * mse_loss(*scene.colour_space.prediction_and_target(radiance, batch.rgb))
        return value
