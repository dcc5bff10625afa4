"""Penalty for light that passes the whole volume."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "opaque")
class Opaque(Loss):
    """Penalize the squared final transmittance of each ray, for fields that cover all of space.

    Without this loss, a background of constant colour would replace objects of the same colour. The loss is the
    expected squared error that a background of random grey levels (variance 1) would cause.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        passed = renderings[-1].transmittance.square()
        return batch.per_pixel(renderings[-1].path.sum_polylines(passed)).mean()
