"""Template: a loss of your own in one file. Use it with `+loss.opacity_entropy.weight=0.001`."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.parts import Batch, Loss, Rendering, Scene, register


@register("loss", "opacity_entropy")
class OpacityEntropy(Loss):
    """Penalize the entropy of the opacity at the finest level, such that rays pass or stop but are not dimmed."""

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        # `opacity` sums the polylines of each ray, and `per_pixel` averages the rays of each pixel.
        opacity = batch.per_pixel(renderings[-1].opacity).clamp(1e-5, 1 - 1e-5)
        return -(opacity * torch.log(opacity) + (1 - opacity) * torch.log(1 - opacity)).mean()
