"""The re-rendering error."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import mse_loss

from nerfro.allowed import Natural, NotNegative
from nerfro.boundaries.base import Boundary
from nerfro.losses.base import Loss, Model
from nerfro.registry import register
from nerfro.types import Batch, Rendering


@register("loss", "photometric")
class Photometric(Loss):
    """Mean squared colour error of the last level, plus that of earlier ones (paper, Eqn. lossRGB).

    The mean is over pixels and channels, as in the authors' code; the paper's norm is three times that. Pixels whose
    rays part widely teach the boundary nothing: it would learn speckle from them.

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
            radiance = batch.of_pixels(_teaching(rendering, batch, model.boundary))
            value = value + factor * mse_loss(*model.difference(radiance, target))
        return value


def _teaching(rendering: Rendering, batch: Batch, boundary: Boundary) -> Float[Tensor, "R 3"]:
    """The rays' radiance, of which that of pixels whose rays part has no gradient by the boundary.

    What bends and tints the rays still learns from where they leave.
    """
    if (together := batch.num_together) is None:
        return rendering.rgb
    first = int(torch.searchsorted(rendering.path.ray, together))
    path = rendering.path[first:].changed(ray=rendering.path.ray[first:] - together)
    light = rendering.boundary_rgb[first:]
    learned = light - light.detach()
    if path.exit_directions.requires_grad or path.absorption.requires_grad:
        fixed = {name: parameter.detach() for name, parameter in boundary.named_parameters()}
        bent = functional_call(boundary, fixed, (path.exits(),))
        if path.absorbs:
            bent = bent * path.transmitted(path.far[:, None])[:, 0]
        bent = bent if rendering.gain is None else bent * rendering.gain[first:]
        learned = learned - (bent - bent.detach())
    from_boundary = path.per_ray(rendering.transmittance[first:, None] * learned)
    return torch.cat([rendering.rgb[:together], rendering.rgb[together:] - from_boundary])
