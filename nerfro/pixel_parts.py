"""Rays through the parts of pixels: a pixel shows the mean over its square, which one ray may not stand for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.rays import Rays


@dataclass(frozen=True)
class PixelParts:
    """Rays through the centres of side x side equal parts of pixels, numbered pixel by pixel.

    Attributes:
        cameras: whose pixels.
        side: parts in each direction; 1 is the pixel itself.
        pixels: the divided pixels, as view * H * W + row * W + column; all by default.
    """

    cameras: Cameras
    side: int = 1
    pixels: Int[Tensor, "U"] | None = None

    @property
    def rays_per_pixel(self) -> int:
        return self.side**2

    def __len__(self) -> int:
        cameras = self.cameras
        num_pixels = len(cameras) * cameras.height * cameras.width if self.pixels is None else len(self.pixels)
        return num_pixels * self.rays_per_pixel

    def to(self, device: torch.device | str) -> PixelParts:
        return replace(
            self, cameras=self.cameras.to(device), pixels=None if self.pixels is None else self.pixels.to(device)
        )

    def rays(self, number: Int[Tensor, "R"]) -> Rays:
        """The rays of some numbers, in [0, len(self))."""
        width, height = self.cameras.width, self.cameras.height
        pixel, part = number // self.rays_per_pixel, number % self.rays_per_pixel
        if self.pixels is not None:
            pixel = self.pixels[pixel]
        place = None if self.side == 1 else part_centres(self.side).to(part.device)[part]
        return self.cameras.rays(pixel // (height * width), pixel // width % height, pixel % width, place)


def part_centres(side: int) -> Float[Tensor, "K 2"]:
    """Centres of side x side equal parts of a pixel, as (x, y) in [0, 1)."""
    ticks = (torch.arange(side) + 0.5) / side
    return torch.cartesian_prod(ticks, ticks).view(-1, 2)
