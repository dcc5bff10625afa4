"""The model of the paper."""

from __future__ import annotations

from typing import Any, Literal

from omegaconf import DictConfig

from nerfro.core.compositing import composite
from nerfro.core.light import Colour
from nerfro.core.types import Batch, Path, Rendering
from nerfro.data.base import Views
from nerfro.geometry.space import Space
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer


@register("model", "refractive")
class RefractiveModel(Renderer):
    """Render bent rays with one radiance field for each sampling level, and a background (paper, section 2).

    Args:
        background_direction: direction of the background radiance: the `exit` direction of the path, or that of the
            `last_coarse` sample, as in the authors' code.
        colour: colour space in which fields and background return radiance and rays sum radiance: `linear`, `hdr` for
            photographs in linear light (see `ColourSpace`), or `srgb` as in the authors' code. None derives `linear` or
            `hdr` from the photographs.
    """

    empty_shows_background = True

    def __init__(
        self,
        components: Components,
        background_direction: Literal["exit", "last_coarse"] = "exit",
        colour: Colour | None = None,
    ) -> None:
        super().__init__(components, components.point_sampler.num_levels, colour)
        self.background_direction = background_direction

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        if settings.model.get("colour") == "srgb":
            views.refuse_linear_light("model.colour=srgb")
        return {"colour": "hdr" if views.in_linear_light else "linear"}

    def render_path(self, path: Path, batch: Batch | None = None) -> list[Rendering]:
        samples = self.sample(path, None, batch)
        directions = None if self.background_direction == "exit" else samples.directions[:, -1]
        background_radiance = self.background(path, batch, directions)
        renderings = [composite(samples, self.scene.fields[0](samples), background_radiance, path)]
        for field in self.scene.fields[1:]:
            samples = self.sample(path, renderings[-1], batch)
            renderings.append(composite(samples, field(samples), background_radiance, path))
        return renderings
