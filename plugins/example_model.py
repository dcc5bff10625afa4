"""Template: a model of your own in one file. Use it with `model=haze`."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import nn

from nerfro.parts import Batch, Path, Positive, RefractiveModel, Rendering, register


@register("model", "haze")
class Haze(RefractiveModel):
    """Refractive model behind a homogeneous haze, whose density and colour are learned.

    Args:
        density: initial density of the haze, per world unit.
        options: options of `RefractiveModel`.
    """

    empty_shows_background = False  # the haze changes rays that miss the field, too

    def __init__(self, density: Positive = 0.01, **options: Any) -> None:
        super().__init__(**options)
        self.log_density = nn.Parameter(torch.tensor(density).log())
        self.colour = nn.Parameter(torch.zeros(3))

    def render_path(self, path: Path, batch: Batch | None = None) -> list[Rendering]:
        clear = torch.exp(-self.log_density.exp() * path.main_polyline(path.far - path.near))[:, None]
        renderings = super().render_path(path, batch)
        return [
            dataclasses.replace(r, radiance=clear * r.radiance + (1 - clear) * self.colour.sigmoid())
            for r in renderings
        ]
