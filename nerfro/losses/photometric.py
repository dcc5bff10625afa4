"""The re-rendering error."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerfro.allowed import Natural, NotNegative
from nerfro.losses.base import Loss, Model
from nerfro.registry import register
from nerfro.types import Batch, Rendering


@register("loss", "photometric")
class Photometric(Loss):
    """Mean squared colour error of the last level, plus that of earlier ones (paper, Eqn. lossRGB).

    The mean is over pixels and channels, as in the authors' code; the paper's norm is three times that. Divided pixels
    teach the field alone: their rays part so widely that the boundary would learn speckle from them.

    Args:
        coarse: factor of the earlier levels' errors; 1 in the paper, 0.1 in mip-NeRF.
    """

    def __init__(
        self, weight: NotNegative = 1.0, start: Natural = 0, ramp: Natural = 0, coarse: NotNegative = 1.0
    ) -> None:
        super().__init__(weight, start, ramp)
        self.coarse = coarse

    def forward(self, renderings: list[Rendering], batch: Batch, model: Model) -> Float[Tensor, ""]:
        value, target = torch.zeros((), device=batch.rgb.device), batch.of_pixels(batch.rgb)
        for rendering, factor in zip(renderings, [self.coarse] * (len(renderings) - 1) + [1.0], strict=True):
            radiance = batch.of_pixels(_teaching(rendering, batch))
            value = value + factor * mse_loss(*model.difference(radiance, target))
        return value


def _teaching(rendering: Rendering, batch: Batch) -> Float[Tensor, "R 3"]:
    """The rays' radiance, of which that of divided pixels has no gradient in the boundary."""
    if batch.num_whole is None:
        return rendering.rgb
    boundary = rendering.boundary_rgb
    from_boundary = rendering.path.per_ray(rendering.transmittance[:, None] * (boundary - boundary.detach()))
    return torch.cat([rendering.rgb[: batch.num_whole], (rendering.rgb - from_boundary)[batch.num_whole :]])
