"""Light that passes all of the volume."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering


@register("loss", "opaque")
class Opaque(Loss):
    """Mean square of the transmittance at the end of each ray: where the field is all of space, every ray ends in it.

    A boundary beyond of any colour would otherwise explain things of that colour, and show through where they stand.
    The loss is what a background of random grey of that variance would cost on average.
    """

    weight = 1e-2

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        passed = renderings[-1].transmittance.square()
        return batch.per_pixel(renderings[-1].path.per_ray(passed)).mean()
