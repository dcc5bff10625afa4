"""Images of 8-bit sRGB, the format in which predictions are written and scored."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.files.atomic import atomic_file
from nerfro.files.reading import open_image


def to_8bit(rgb: Float[Tensor, "*batch 3"]) -> UInt8[Tensor, "*batch 3"]:
    """Clip finite sRGB values to [0, 1] and round to the nearest of 256 levels.

    Truncation instead of rounding would darken every image by half a level.
    """
    if not rgb.is_floating_point():
        raise NerfroError(f"expected sRGB values of floating point in [0, 1], got {rgb.dtype}; divide levels by 255")
    num_bad = int((~torch.isfinite(rgb)).sum())
    if num_bad:
        raise NerfroError(
            f"{num_bad} of the image's {rgb.numel()} values are NaN or infinite: the model has diverged; "
            "train with a lower learning rate or with gradient clipping"
        )
    return (rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8)


def round_to_8bit(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Round to the values of a saved PNG: multiples of 1/255 in [0, 1], in the type of the input."""
    return to_8bit(rgb).to(rgb.dtype) / 255


def save_png(path: Path | str, rgb: Float[Tensor, "H W 3"]) -> None:
    """Clip sRGB values to [0, 1], round them, and write an 8-bit PNG atomically."""
    if rgb.ndim != 3 or rgb.shape[-1] != 3:
        raise NerfroError(f"cannot write {path}: expected an image [H, W, 3], got {list(rgb.shape)}")
    save_image(path, Image.fromarray(to_8bit(rgb).cpu().numpy()))


def save_image(path: Path | str, image: Image.Image, **options: Any) -> None:
    """Write an image as PNG atomically; `options` are those of Pillow's writer."""
    with atomic_file(path) as file:
        image.save(file, "PNG", **options)


def data_uri(pixels: UInt8[np.ndarray, "H W 3"], form: str, **options: Any) -> str:
    """Encode an image as a data URI; `form` is PNG or JPEG, and `options` are those of Pillow's writer."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, form, **options)
    return f"data:image/{form.lower()};base64,{base64.b64encode(file.getvalue()).decode()}"


def load_png(path: Path | str) -> Float[Tensor, "H W 3"]:
    """Read an 8-bit grey or RGB image without transparency as float32 sRGB values, multiples of 1/255."""
    with open_image(Path(path)) as (image, bits):
        if image.mode not in ("RGB", "L") or image.has_transparency_data or bits > 8:
            raise NerfroError(
                f"{path} has pixels of mode {image.mode} with {bits} bits; "
                "allowed are 8-bit RGB and grey: convert it, with transparency composited first"
            )
        levels = np.array(image.convert("RGB"))
    return torch.from_numpy(levels).float() / 255
