"""The mip-NeRF baseline."""

from __future__ import annotations

from typing import Literal

from jaxtyping import Bool
from torch import Tensor

from nerfro.draws import Draws
from nerfro.registry import register
from nerfro.rendering import Components, Renderer, composite
from nerfro.types import Path, Rendering


@register("model", "mip_nerf")
class MipNerfModel(Renderer):
    """Render straight rays with one radiance field for all sampling levels, as mip-NeRF, and a background.

    Args:
        colour: see `model=refractive`.
    """

    empty_shows_boundary = True

    def __init__(self, components: Components, colour: Literal["linear", "srgb"] = "linear") -> None:
        super().__init__(components, 1, colour)

    def render_path(
        self, path: Path, draws: Draws | None = None, teaches_background: Bool[Tensor, "R"] | None = None
    ) -> list[Rendering]:
        boundary_rgb = self.background(path, teaches_background)
        (field,) = self.scene.fields
        renderings: list[Rendering] = []
        for _ in range(self.point_sampler.num_levels):
            samples = self.point_sampler(path, renderings[-1] if renderings else None, draws)
            renderings.append(composite(samples, field(samples), boundary_rgb, path))
        return renderings
