"""Photographs that are cut out on one colour: what is beyond the volume is known then, and is that colour."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerfro.data.lazy_images import LazyImages
from nerfro.light import to_linear
from nerfro.losses.backdrop import shows
from nerfro.registry import find

# Pictures that are looked at, evenly spread.
_LOOKED_AT = 8
# Share of a picture's border that shows the backdrop, in how many of the pictures, and share of all of their pixels.
# A lens's black corners reach less far inwards, and the border of a photographed room is never one level throughout.
_OF_BORDER, _OF_PICTURES, _OF_PIXELS = 0.9, 0.8, 0.3


def settle_backdrop(config: DictConfig, images: LazyImages | Float[Tensor, "V H W 3"]) -> None:
    """Where photographs are cut out on one colour, tell `loss=backdrop`, and put that colour beyond the volume.

    Args:
        config: of a run, see `TrainConfig`. Nothing is done where it has no such loss, or none that weighs anything.
        images: of the training views.
    """
    loss = config.loss.get("backdrop")
    if not loss or not loss.get("weight", 1):
        return
    if loss.get("colour") is None:
        loss.colour = find_backdrop(images)
    if loss.colour is not None:
        colour = torch.tensor(list(loss.colour))
        radiance = colour if config.model.get("colour") == "srgb" else to_linear(colour)
        config.boundary = {"_target_": find("boundary", "constant").target, "rgb": radiance.tolist()}


def describe(config: DictConfig) -> str:
    """A line on what was found, for whoever started a run; nothing where there is no backdrop."""
    colour = OmegaConf.select(config, "loss.backdrop.colour")
    if colour is None:
        return ""
    levels = ", ".join(f"{255 * value:.0f}" for value in colour)
    return f"Photographs are cut out on ({levels}), so that is beyond the volume; loss.backdrop.weight=0 for a sky.\n"


def find_backdrop(images: LazyImages | Float[Tensor, "V H W 3"]) -> list[float] | None:
    """The one colour (sRGB in [0, 1]) on which nearly all of the pictures are cut out, or None."""
    step = max(1, len(images) // _LOOKED_AT)
    looked_at = [images[view] for view in range(0, len(images), step)]
    borders = [picture[_border(*picture.shape[:2])] for picture in looked_at]
    colour = torch.stack([of_one.median(0).values for of_one in borders]).median(0).values
    cut_out = torch.tensor([float(shows(of_one, colour).double().mean()) >= _OF_BORDER for of_one in borders])
    share = torch.stack([shows(picture, colour).double().mean() for picture in looked_at]).median()
    return colour.tolist() if cut_out.double().mean() >= _OF_PICTURES and share >= _OF_PIXELS else None


def _border(height: int, width: int) -> Bool[Tensor, "H W"]:
    """The outermost pixels of a picture."""
    outermost = torch.ones(height, width, dtype=torch.bool)
    outermost[1:-1, 1:-1] = False
    return outermost
