"""A texture of the whole sphere as the background."""

from __future__ import annotations

import math
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.allowed import Count
from nerfro.boundaries import cube_map
from nerfro.boundaries.base import Boundary
from nerfro.errors import NerfroError
from nerfro.files import lat_long
from nerfro.registry import register
from nerfro.types import Exits

# Softplus of 0 is log 2.
_GREY = 0.5 / math.log(2)
_BLACK = 1e-3
# Texels along each side of a face of the levels, if neither a list nor photographs define them.
_RESOLUTIONS = (4, 8, 16, 32, 64, 128, 256)


@register("boundary", "envmap")
class EnvironmentMap(Boundary):
    """Squared softplus of a sum of cube maps of increasing resolution.

    Coarse levels fill in directions that no ray has sampled. The map has no preferred axis. It is initialized
    to an even grey or to a given image.

    Args:
        resolutions: texels along each side of a face (90 degrees) of each level. None derives the finest level from the
            width of a pixel of the photographs.
        image: initial equirectangular image with z up (.png, .jpg, .hdr or .exr); None for grey.
    """

    padded: Int[Tensor, "Q"]

    def __init__(
        self,
        resolutions: list[Count] | None = None,
        image: str | None = None,
    ) -> None:
        super().__init__()
        resolutions = list(_RESOLUTIONS) if resolutions is None else resolutions
        if len(resolutions) == 0:
            raise NerfroError("boundary=envmap: resolutions is empty; give one or more")
        self.levels = cube_map.CubeLevels(tuple(resolutions))
        self.texels = nn.Parameter(torch.zeros(self.levels.num_texels, 3))
        padded = torch.cat([cube_map.padded_texels(n).flatten() for n in resolutions])
        self.register_buffer("padded", padded, persistent=False)
        if image is not None:
            self.set_lat_long(lat_long.load_lat_long(image))

    @classmethod
    def of_texels(cls, radiance: Float[Tensor, "T 3"]) -> EnvironmentMap:
        """Make a map with fixed linear radiance at the `cube_map.texel_directions` of one level."""
        sky = cls([math.isqrt(len(radiance) // 6)])
        sky.requires_grad_(False).texels.copy_(_raw(radiance))
        return sky.eval()

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        face, coordinates = cube_map.project(exits.directions.float().reshape(-1, 3))
        if face.device.type == "cpu":
            from nerfro.boundaries.cube_map_cpu import lookup  # compiled code, so only where it is used
        else:
            lookup = cube_map.lookup
        raw = lookup(face, coordinates, self.texels, self.padded, self.levels)
        return _radiance(raw).view(exits.directions.shape)

    @torch.no_grad()
    def to_lat_long(self, height: int) -> Float[Tensor, "H 2*H 3"]:
        """Render an equirectangular image of linear radiance: z up, +x in the middle (see `lat_long.directions`)."""
        return self(Exits(lat_long.directions(height).to(self.texels.device)))

    def save_lat_long(self, path: Path | str, height: int = 512) -> None:
        """Write an equirectangular image: clipped sRGB for .png, linear radiance for .hdr and .exr."""
        lat_long.save_lat_long(path, self.to_lat_long(height).cpu())

    @torch.no_grad()
    def set_lat_long(self, radiance: Float[Tensor, "H 2*H 3"]) -> None:
        """Set the finest level to the linear radiance of an equirectangular image, and the coarser levels to zero."""
        n = self.levels.resolutions[-1]
        radiance = lat_long.sample(radiance, cube_map.texel_directions(n), width=4 * n)
        self.texels.zero_()
        self.texels[self.levels.offsets[-1] :] = _raw(radiance).to(self.texels)


def _radiance(raw: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Map raw values to linear radiance, by the square of a softplus that is 0.5 at 0; see `HashGridField`."""
    return (F.softplus(raw.float()) * _GREY).square()


def _raw(radiance: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Invert `_radiance`; the darkest value is slightly above black."""
    y = (radiance.sqrt() / _GREY).clamp(min=_BLACK)
    return y + torch.log(-torch.expm1(-y))
