"""The re-rendering error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
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

    The mean is over pixels and channels, as in the authors' code; the paper's norm is three times that. Divided pixels
    teach the field alone: their rays part so widely that the boundary would learn speckle from them.

    Args:
        coarse: factor of the earlier levels' errors; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(self, weight: float = 1.0, start: int = 0, ramp: int = 0, coarse: float = 1.0) -> None:
        super().__init__(weight, start, ramp)
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, model: NerfModel) -> Float[Tensor, ""]:
        *coarse, fine = (batch.pixel_colours(_teaching(rendering, batch)) for rendering in renderings)
        target = batch.pixel_colours(batch.rgb)
        value = mse_loss(fine, target)
        for rgb in coarse:
            value = value + self.coarse * mse_loss(rgb, target)
        return value


def _teaching(rendering: Rendering, batch: Batch) -> Float[Tensor, "R 3"]:
    """The rendered colours, of which those of divided pixels have no gradient in the boundary."""
    if batch.num_whole is None:
        return rendering.rgb
    whole, divided = rendering.rgb[: batch.num_whole], rendering.rgb[batch.num_whole :]
    boundary = rendering.boundary_rgb[batch.num_whole :]
    passed = rendering.transmittance[batch.num_whole :, None]
    return torch.cat([whole, divided - passed * (boundary - boundary.detach())])
