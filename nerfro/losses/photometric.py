"""The re-rendering error."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.types import Batch, Rendering

if TYPE_CHECKING:
    from nerfro.models.base import NerfModel


@register("loss", "photometric")
class Photometric(Loss):
    """Mean squared colour error of the last level, plus that of earlier ones (paper, Eqn. lossRGB).

    The mean is over rays and channels, as in the authors' code; the paper's norm is three times that.

    Args:
        coarse: factor of the earlier levels' errors; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(self, weight: float = 1.0, start: int = 0, ramp: int = 0, coarse: float = 1.0) -> None:
        super().__init__(weight, start, ramp)
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, model: NerfModel) -> Float[Tensor, ""]:
        value = mse_loss(renderings[-1].rgb, batch.rgb)
        for rendering in renderings[:-1]:
            value = value + self.coarse * mse_loss(rendering.rgb, batch.rgb)
        return value
