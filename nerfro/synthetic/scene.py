"""Description of a scene: a glass body, coloured objects inside, and the surroundings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfro.files import lat_long
from nerfro.synthetic.surface import SurfaceMesh

Sky = Callable[[np.ndarray], np.ndarray]
"""Maps unit directions [..., 3], z up, to linear radiance [..., 3] of at most 1, so that 8-bit images never clip."""


def lat_long_texture(sky: Sky, height: int, supersampling: int = 2) -> np.ndarray:
    """Return the sky as a float32 lat-long image [H, 2H, 3] of linear radiance, averaged over each pixel."""
    k = supersampling
    texture = np.empty((height, 2 * height, 3), np.float32)
    fine = lat_long.directions(k * height).numpy()
    for row in range(height):  # by rows, because the intermediate arrays of a 4k sky exceed the memory
        band = sky(fine[k * row : k * (row + 1)])
        texture[row] = band.reshape(k, 2 * height, k, 3).mean((0, 2))
    return texture


Vector = Sequence[float] | np.ndarray
"""Three numbers along x, y, z."""


@dataclass(frozen=True)
class Panel:
    """A rectangle with an image on the front; the back is black.

    Attributes:
        corner: upper left corner [3], world units.
        right: upper edge [3], from left to right.
        down: left edge [3], from top to bottom.
        image: sRGB in [0, 1], float32 [H, W, 3].
        glows: whether the image is emitted radiance, equal in all directions, instead of albedo.
        smooth: whether the image is interpolated between pixels.
    """

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    image: np.ndarray
    glows: bool = False
    smooth: bool = True

    @property
    def to_world(self) -> np.ndarray:
        """Matrix [4, 4] from the square [-1, 1]^2 of x (right) and y (up) to the world; z points to the front."""
        matrix = np.eye(4)
        out = np.cross(self.down, self.right)
        columns = [0.5 * self.right, -0.5 * self.down, out / np.linalg.norm(out)]
        matrix[:3] = np.stack([*columns, self.corner + 0.5 * (self.right + self.down)], -1)
        return matrix


@dataclass(frozen=True)
class Part:
    """A surface with a material of its own: a refractive body, or diffuse content.

    Attributes:
        name: name in messages and files.
        surface: triangles with normals; vertex colours, if there are any, are factors of the albedo.
        ior: refractive index of a body; None for content.
        absorption: absorption of a body for each colour channel, per world unit.
        outer_ior: refractive index around a body.
        outer_absorption: absorption around the surface, per world unit.
        albedo: linear albedo of content.
        texture: further factor of the albedo, sRGB in [0, 1], float32 [H, W, 3], or None.
        texture_coordinates: float32 [V, 2] from the upper left corner of the texture, or None.
    """

    name: str
    surface: SurfaceMesh
    ior: float | None = None
    absorption: Vector = (0.0, 0.0, 0.0)
    outer_ior: float = 1.0
    outer_absorption: Vector = (0.0, 0.0, 0.0)
    albedo: Vector = (1.0, 1.0, 1.0)
    texture: np.ndarray | None = None
    texture_coordinates: np.ndarray | None = None


@dataclass(frozen=True)
class SyntheticScene:
    """A refractive object in world units, z up.

    Attributes:
        ior: refractive index of the glass; the index of the surroundings is 1.
        glass: closed outer surface of the glass.
        interior: coloured diffuse surfaces inside the glass, without contact to the outer surface.
        sky: linear radiance in [0, 1] from every direction, or None where panels close the scene.
        panels: flat surfaces at finite distance around the object.
        tint: linear factor per colour channel on each crossing of the glass surface, as in the paper's image formation,
            where paths are not absorbed.
        absorption: absorption of the glass for each colour channel, per world unit (Beer-Lambert).
        aim: point in the centre of the images.
        parts: bodies and contents with materials of their own, which are rendered in place of glass and interior.
    """

    ior: float
    glass: SurfaceMesh
    interior: SurfaceMesh
    sky: Sky | None
    panels: tuple[Panel, ...] = ()
    tint: Vector = (1.0, 1.0, 1.0)
    absorption: Vector = (0.0, 0.0, 0.0)
    aim: Vector = (0.0, 0.0, 0.0)
    parts: tuple[Part, ...] = ()

    def with_glass(self, ior: float | None, absorption: Vector) -> SyntheticScene:
        """Return the scene with another index, unless it is None, and another absorption of the glass.

        An absorption of zero leaves that of parts unchanged.
        """
        parts = self.parts
        if ior is not None:
            parts = tuple(replace(part, ior=ior) if part.ior is not None else part for part in parts)
        if any(absorption):
            parts = tuple(replace(part, absorption=absorption) if part.ior is not None else part for part in parts)
        return replace(self, ior=self.ior if ior is None else ior, absorption=absorption, parts=parts)
