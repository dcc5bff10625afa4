"""The paper's loss on the background colour (Eqn. 9); its other losses are in `nerfro.losses.terms`."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, Exits, Rendering
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene


@register("loss", "smoothness")
class Smoothness(Loss):
    """Penalize squared differences of the background colour between neighbouring directions (paper, Eqn. 9).

    Args:
        tile_size: side in pixels of a random window of a random training view, whose viewing directions are compared.
    """

    start = 2500

    def __init__(self, tile_size: Annotated[int, Ge(2)] = 128) -> None:
        super().__init__()
        self.tile_size = tile_size

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        return tile_roughness(
            scene.colour_space.to_srgb(scene.background(Exits(batch.cameras.tile(self.tile_size, batch.draws))))
        )


def tile_roughness(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Average the mean squared differences of horizontal and of vertical neighbours."""
    return 0.5 * (rgb[:, 1:] - rgb[:, :-1]).square().mean() + 0.5 * (rgb[1:] - rgb[:-1]).square().mean()
