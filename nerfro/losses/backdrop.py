"""Light that stops where a photograph shows the plain backdrop that it is cut out on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.losses.base import Loss
from nerfro.registry import register
from nerfro.rendering import Scene
from nerfro.types import Batch, Rendering

# A level of 255, and what rounding adds.
_NEAR = 1.5 / 255


def shows(rgb: Float[Tensor, "*batch 3"], backdrop: Float[Tensor, "3"]) -> Bool[Tensor, "*batch"]:
    """Which pixels have the backdrop's colour."""
    return ((rgb - backdrop).abs() < _NEAR).all(-1)


@register("loss", "backdrop")
class Backdrop(Loss):
    """Mean share of light that stops somewhere on the way, of the rays whose pixels show a plain backdrop.

    White before white contradicts no photograph. Without this loss, walls stand where few cameras look, and hide the
    object from other places. With it, silhouettes carve them away.

    Args:
        colour: of the backdrop (sRGB in [0, 1]). By default it is found from the training views; where they have no
            such backdrop the loss is 0.
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
        stopped = rendering.path.per_ray(1 - rendering.transmittance)
        return (batch.per_pixel(stopped) * shows(batch.rgb, self.colour)).mean()
