"""A texture of the whole sphere as the boundary."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.boundaries import cube_map, lat_long
from nerfro.boundaries.base import Boundary
from nerfro.errors import NerfroError
from nerfro.fields.mlp import RGB_PADDING, padded_sigmoid
from nerfro.registry import register


@register("boundary", "envmap")
class EnvironmentMap(Boundary):
    """Sigmoid of a sum of cube maps, coarse to fine, so that coarse ones fill in where no ray has looked.

    It starts as an even grey, or as the given picture. There is no preferred axis; lat-long pictures have z up.

    Args:
        resolutions: texels along a face's side (90 degrees) of each level; the default's finest texel is 0.35 degrees.
        image: lat-long picture to start from (.png, .jpg, .hdr or .exr); none for grey.
    """

    padded: Int[Tensor, "Q"]

    def __init__(
        self,
        resolutions: list[int] = (4, 8, 16, 32, 64, 128, 256),  # type: ignore[assignment]
        image: str | None = None,
    ) -> None:
        super().__init__()
        if len(resolutions) == 0 or min(resolutions) < 1:
            raise NerfroError(f"boundary=envmap: resolutions={list(resolutions)}; give one or more, each at least 1")
        self.levels = cube_map.CubeLevels(tuple(resolutions))
        self.texels = nn.Parameter(torch.zeros(self.levels.num_texels, 3))
        padded = torch.cat([cube_map.padded_texels(n).flatten() for n in resolutions])
        self.register_buffer("padded", padded, persistent=False)
        if image is not None:
            self.set_lat_long(lat_long.load_lat_long(image))

    def forward(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        face, coordinates = cube_map.project(directions.detach().float().reshape(-1, 3))
        if face.device.type == "cpu":
            from nerfro.boundaries.cube_map_cpu import lookup  # compiled code, so only where it is used
        else:
            lookup = cube_map.lookup
        return padded_sigmoid(lookup(face, coordinates, self.texels, self.padded, self.levels)).view(directions.shape)

    @torch.no_grad()
    def to_lat_long(self, height: int) -> Float[Tensor, "H 2*H 3"]:
        """The sky as a lat-long picture, z up, +x in the middle (see `lat_long.directions`); sRGB in [0, 1]."""
        return self(lat_long.directions(height).to(self.texels.device)).clamp(0, 1)

    def save_lat_long(self, path: Path | str, height: int = 512) -> None:
        """Write the sky as a lat-long picture: sRGB for .png, linear radiance for .hdr and .exr."""
        lat_long.save_lat_long(path, self.to_lat_long(height).cpu())

    @torch.no_grad()
    def set_lat_long(self, rgb: Float[Tensor, "H 2*H 3"]) -> None:
        """Start from a picture: the finest level takes its colours, the coarser ones become zero."""
        n = self.levels.resolutions[-1]
        colour = lat_long.sample(rgb, cube_map.texel_directions(n), width=4 * n)
        self.texels.zero_()
        raw = torch.logit((colour.clamp(0, 1) + RGB_PADDING) / (1 + 2 * RGB_PADDING))
        self.texels[self.levels.offsets[-1] :] = raw.to(self.texels)
