"""8-bit sRGB pictures: the form in which predictions are written, and scored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.files.reading import open_image


def to_8bit(rgb: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Clip finite sRGB values to [0, 1] and round to the nearest of 256 levels.

    Truncation instead of rounding would darken every picture by half a level.
    """
    if not rgb.is_floating_point():
        raise NerfroError(f"expected sRGB values of floating point in [0, 1], got {rgb.dtype}; divide levels by 255")
    num_bad = int((~torch.isfinite(rgb)).sum())
    if num_bad:
        raise NerfroError(
            f"{num_bad} of the picture's {rgb.numel()} values are NaN or infinite: the model has diverged; "
            "train with a lower learning rate or with gradient clipping"
        )
    return (rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8)


def round_to_8bit(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """The values that a viewer of the saved PNG sees: multiples of 1/255 in [0, 1], of the input's type."""
    return to_8bit(rgb).to(rgb.dtype) / 255


def save_png(path: Path | str, rgb: Float[Tensor, "H W 3"]) -> None:
    """Write sRGB values, clipped to [0, 1] and rounded, as 8-bit PNG, whole or not at all."""
    if rgb.ndim != 3 or rgb.shape[-1] != 3:
        raise NerfroError(f"cannot write {path}: expected a picture [H, W, 3], got {list(rgb.shape)}")
    save_picture(path, Image.fromarray(to_8bit(rgb).cpu().numpy()))


def save_picture(path: Path | str, picture: Image.Image, optimize: bool = False) -> None:
    """Write any picture as PNG, whole or not at all."""
    with atomic_file(path) as file:
        picture.save(file, "PNG", optimize=optimize)


def load_png(path: Path | str) -> Float[Tensor, "H W 3"]:
    """Read an 8-bit grey or RGB picture without transparency as float32 sRGB values, multiples of 1/255."""
    with open_image(Path(path)) as (image, bits):
        if image.mode not in ("RGB", "L") or image.has_transparency_data or bits > 8:
            raise NerfroError(
                f"{path} has pixels of mode {image.mode} with {bits} bits; "
                "allowed are 8-bit RGB and grey: convert it, with transparency composited first"
            )
        levels = np.array(image.convert("RGB"))
    return torch.from_numpy(levels).float() / 255
