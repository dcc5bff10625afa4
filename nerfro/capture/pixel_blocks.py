"""Photographs made smaller by whole numbers: squares of pixels become one."""

from __future__ import annotations

from jaxtyping import Float, Shaped
from torch import Tensor

from nerfro.cameras import Cameras, Window
from nerfro.capture.silhouettes import pixel_stride


class PixelBlocks:
    """Squares of so many pixels a side; what is left over at the right and below is cut off.

    Args:
        cameras: of the photographs.
        max_pixels: that their longer side may have in the end.
    """

    def __init__(self, cameras: Cameras, max_pixels: int) -> None:
        self._stride = pixel_stride(cameras, max_pixels)
        self.height, self.width = cameras.height // self._stride, cameras.width // self._stride
        self._window = Window(0, 0, self.height * self._stride, self.width * self._stride)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Those of the smaller photographs."""
        return cameras.crop(self._window).resized(self.width, self.height)

    def mean(self, picture: Shaped[Tensor, "H W *C"]) -> Float[Tensor, "h w *C"]:
        """Of each block."""
        blocks = self._window.cut(picture.float()[None])[0].unflatten(1, (self.width, self._stride))
        return blocks.unflatten(0, (self.height, self._stride)).mean((1, 3))
