"""Penalty for density in front of a plain backdrop of the photographs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene

# Tolerance of one level of 255, plus rounding errors.
_NEAR = 1.5 / 255


def shows(rgb: Float[Tensor, "*batch 3"], backdrop: Float[Tensor, "3"]) -> Bool[Tensor, "*batch"]:
    """Return which pixels have the colour of the backdrop."""
    return ((rgb - backdrop).abs() < _NEAR).all(-1)


@register("loss", "backdrop")
class Backdrop(Loss):
    """Penalize the opacity of rays whose pixels show a plain backdrop.

    White density in front of a white backdrop contradicts no photograph. Without this loss, such density remains where
    few cameras look, and hides the object from other directions.

    Args:
        colour: colour of the backdrop, sRGB in [0, 1]. By default, the colour is derived from the training views; the
            loss is 0 for views without a plain backdrop.
    """

    colour: Float[Tensor, "3"] | None

    weight = 0.1

    def __init__(self, colour: Sequence[float] | None = None) -> None:
        super().__init__()
        if colour is not None and (len(colour) != 3 or not all(0 <= value <= 1 for value in colour)):
            raise NerfroError(f"loss=backdrop: colour={list(colour)} is no sRGB colour; give three numbers in [0, 1]")
        self.register_buffer("colour", None if colour is None else torch.tensor(colour), persistent=False)

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        if self.colour is None:
            return batch.rgb.new_zeros(())
        rendering = renderings[-1]
        stopped = rendering.path.sum_polylines(1 - rendering.transmittance)
        return (batch.per_pixel(stopped) * shows(batch.rgb, self.colour)).mean()
