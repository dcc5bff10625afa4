"""Detection of photographs with a plain backdrop, whose colour becomes the background."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerfro.core.light import to_linear
from nerfro.data.lazy_images import LazyImages
from nerfro.losses.backdrop import shows
from nerfro.registry.registration import find

# Number of images that are examined.
_NUM_IMAGES = 8
# Least fraction of the border of an image that shows the backdrop, of such images, and of all pixels that show the
# backdrop. The dark corners of a lens are smaller, and the border of a photographed room has several colours.
_OF_BORDER, _OF_IMAGES, _OF_PIXELS = 0.9, 0.8, 0.3


def derive_backdrop(config: DictConfig, images: LazyImages | Float[Tensor, "V H W 3"]) -> None:
    """Set the colour of `loss=backdrop` and of the background if the photographs have a plain backdrop.

    Args:
        config: configuration of a run, see `TrainConfig`; unchanged if the loss is missing or has the weight 0.
        images: images of the training views.
    """
    loss = config.loss.get("backdrop")
    if not loss or not loss.get("weight", 1):
        return
    if loss.get("colour") is None:
        loss.colour = find_backdrop(images)
    if loss.colour is not None:
        colour = torch.tensor(list(loss.colour))
        radiance = colour if config.model.get("colour") == "srgb" else to_linear(colour)
        config.background = {"_target_": find("background", "constant").target, "rgb": radiance.tolist()}


def describe(config: DictConfig) -> str:
    """Describe the backdrop in one line; the result is empty without a backdrop."""
    colour = OmegaConf.select(config, "loss.backdrop.colour")
    if colour is None:
        return ""
    levels = ", ".join(f"{255 * value:.0f}" for value in colour)
    return f"The photographs have a plain backdrop ({levels}), used as background; loss.backdrop.weight=0 learns one.\n"


def find_backdrop(images: LazyImages | Float[Tensor, "V H W 3"]) -> list[float] | None:
    """Return the colour (sRGB in [0, 1]) of the plain backdrop of nearly all images, or None."""
    step = max(1, len(images) // _NUM_IMAGES)
    examined = [images[view] for view in range(0, len(images), step)]
    borders = [image[_border(*image.shape[:2])] for image in examined]
    colour = torch.stack([of_one.median(0).values for of_one in borders]).median(0).values
    cut_out = torch.tensor([float(shows(of_one, colour).double().mean()) >= _OF_BORDER for of_one in borders])
    share = torch.stack([shows(image, colour).double().mean() for image in examined]).median()
    return colour.tolist() if cut_out.double().mean() >= _OF_IMAGES and share >= _OF_PIXELS else None


def _border(height: int, width: int) -> Bool[Tensor, "H W"]:
    """Select the outermost pixels of an image."""
    outermost = torch.ones(height, width, dtype=torch.bool)
    outermost[1:-1, 1:-1] = False
    return outermost
