"""The model of the paper."""

from __future__ import annotations

from typing import Literal

from jaxtyping import Bool
from torch import Tensor

from nerfro.core.draws import Draws
from nerfro.core.types import Path, Rendering
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer, composite


@register("model", "refractive")
class RefractiveModel(Renderer):
    """Render bent rays with one radiance field for each sampling level, and a background (paper, section 2).

    Args:
        background_direction: direction of the background radiance: the `exit` direction of the path, or the direction of
            the `last_coarse` sample, as in the authors' code.
        colour: colour space in which fields and background return radiance and rays sum radiance: `linear`, or `srgb`
            as in the authors' code.
    """

    empty_shows_background = True

    def __init__(
        self,
        components: Components,
        background_direction: Literal["exit", "last_coarse"] = "exit",
        colour: Literal["linear", "srgb"] = "linear",
    ) -> None:
        super().__init__(components, components.point_sampler.num_levels, colour)
        self.background_direction = background_direction

    def render_path(
        self, path: Path, draws: Draws | None = None, teaches_background: Bool[Tensor, "R"] | None = None
    ) -> list[Rendering]:
        samples = self.point_sampler(path, None, draws)
        directions = None if self.background_direction == "exit" else samples.directions[:, -1]
        background_radiance = self.background(path, teaches_background, directions)
        renderings = [composite(samples, self.scene.fields[0](samples), background_radiance, path)]
        for field in self.scene.fields[1:]:
            samples = self.point_sampler(path, renderings[-1], draws)
            renderings.append(composite(samples, field(samples), background_radiance, path))
        return renderings
