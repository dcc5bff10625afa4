"""Downscaling of images by an integer factor."""

from __future__ import annotations

from jaxtyping import Float, Shaped
from torch import Tensor

from nerfro.cameras import Cameras, Window
from nerfro.capture.silhouettes import pixel_stride


class PixelBlocks:
    """Downscaling of images by averaging square blocks; incomplete blocks at the right and bottom are cropped.

    Args:
        cameras: cameras of the images.
        max_pixels: maximum length of the longer side after downscaling.
    """

    def __init__(self, cameras: Cameras, max_pixels: int) -> None:
        self._stride = pixel_stride(cameras, max_pixels)
        self.height, self.width = cameras.height // self._stride, cameras.width // self._stride
        self._window = Window(0, 0, self.height * self._stride, self.width * self._stride)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras of the downscaled images."""
        return cameras.crop(self._window).resized(self.width, self.height)

    def mean(self, image: Shaped[Tensor, "H W *C"]) -> Float[Tensor, "h w *C"]:
        """Average an image over each block."""
        blocks = self._window.cut(image.float()[None])[0].unflatten(1, (self.width, self._stride))
        return blocks.unflatten(0, (self.height, self._stride)).mean((1, 3))
