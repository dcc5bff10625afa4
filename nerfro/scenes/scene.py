"""What a scene is: a glass body, coloured things inside it, and its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

from nerfro.scenes.panels import Panel
from nerfro.scenes.skies import Sky
from nerfro.scenes.surface import Surface


@dataclass(frozen=True)
class Scene:
    """A refractive object in world units, z up.

    Attributes:
        name: what `scene=` selects.
        ior: refractive index of the glass; the surroundings have 1.
        glass: closed outer surface of the glass.
        interior: coloured diffuse surfaces embedded in the glass; they never touch its outer surface.
        sky: linear radiance in [0, 1] from every direction, or None where panels close the scene.
        panels: flat things at finite distance around the object.
        tint: linear factor per colour channel on each crossing of the glass surface. Absorption along the path is not
            part of the paper's image formation, so tinted glass is tinted at its surface.
    """

    name: str
    ior: float
    glass: Surface
    interior: Surface
    sky: Sky | None
    panels: tuple[Panel, ...] = ()
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
