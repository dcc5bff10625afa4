"""Penalty for density in front of a plain backdrop of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from omegaconf import DictConfig
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.types import Batch, Rendering
from nerfro.data.base import Views
from nerfro.data.lazy_images import LazyImages
from nerfro.geometry.space import Space
from nerfro.losses.base import Loss
from nerfro.registry.registration import register
from nerfro.rendering import Scene

# Least fraction of the border of an image that shows the backdrop, of such images, and of all pixels that show the
# backdrop. The dark corners of a lens are smaller, and the border of a photographed room has several colours.
_OF_BORDER, _OF_IMAGES, _OF_PIXELS = 0.9, 0.8, 0.3


def shows(rgb: Float[Tensor, "*batch 3"], backdrop: Float[Tensor, "3"]) -> Bool[Tensor, "*batch"]:
    """Return which pixels have the colour of the backdrop."""
    # The tolerance is one level of 255, plus rounding errors.
    return ((rgb - backdrop).abs() < 1.5 / 255).all(-1)


@register("loss", "backdrop")
class Backdrop(Loss):
    """Penalize the opacity of rays whose pixels show a plain backdrop.

    White density in front of a white backdrop contradicts no photograph. Without this loss, such density remains where
    few cameras look, and hides the object from other directions.

    Args:
        colour: colour of the backdrop, sRGB in [0, 1], which becomes the background. None derives it from the training
            views; the loss is 0 for views without a plain backdrop.
    """

    colour: Float[Tensor, "3"] | None

    weight = 0.1

    def __init__(self, colour: Sequence[float] | None = None) -> None:
        super().__init__()
        if colour is not None and (len(colour) != 3 or not all(0 <= value <= 1 for value in colour)):
            raise NerfroError(f"loss=backdrop: colour={list(colour)} is no sRGB colour; give three numbers in [0, 1]")
        self.register_buffer("colour", None if colour is None else torch.tensor(colour), persistent=False)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        return {"colour": find_backdrop(views.images)} if settings.loss.backdrop.get("weight", cls.weight) else {}

    def forward(self, renderings: list[Rendering], batch: Batch, scene: Scene) -> Float[Tensor, ""]:
        if self.colour is None:
            return batch.rgb.new_zeros(())
        rendering = renderings[-1]
        stopped = rendering.path.sum_polylines(1 - rendering.transmittance)
        return (batch.per_pixel(stopped) * shows(batch.rgb, self.colour)).mean()


def find_backdrop(images: LazyImages | Float[Tensor, "V H W 3"]) -> list[float] | None:
    """Return the colour (sRGB in [0, 1]) of the plain backdrop of nearly all images, or None."""
    step = max(1, len(images) // 8)  # a backdrop is searched in eight images or a few more
    examined = [images[view] for view in range(0, len(images), step)]
    borders = [image[_border(*image.shape[:2])] for image in examined]
    colour = torch.stack([of_one.median(0).values for of_one in borders]).median(0).values
    cut_out = torch.tensor([float(shows(of_one, colour).double().mean()) >= _OF_BORDER for of_one in borders])
    share = torch.stack([shows(image, colour).double().mean() for image in examined]).median()
    is_shown = float(colour.min()) >= 0 and float(colour.max()) <= 1  # photographs in linear light may exceed 1
    return colour.tolist() if is_shown and cut_out.double().mean() >= _OF_IMAGES and share >= _OF_PIXELS else None


def _border(height: int, width: int) -> Bool[Tensor, "H W"]:
    """Select the outermost pixels of an image."""
    outermost = torch.ones(height, width, dtype=torch.bool)
    outermost[1:-1, 1:-1] = False
    return outermost
