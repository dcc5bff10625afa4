"""Images of 8-bit sRGB, the format in which predictions are written and scored, and elements of drawn images."""

from __future__ import annotations

import base64
import io
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
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


GAP = 6  # pixels between images
TEXT_SIZE = 14  # pixels
LINE_HEIGHT = 22  # pixels
PAPER, INK, EMPTY = (255, 255, 255), (25, 25, 25), (225, 225, 225)  # EMPTY: grey of missing values


def sheet(
    images: Sequence[Float[Tensor, "_ _ 3"]], captions: Sequence[str], width: int, columns: int, title: str = ""
) -> Image.Image:
    """Draw sRGB images `width` pixels wide in rows of at most `columns`, with captions below and a title on top.

    Images have the aspect ratio of the first. Captions may have several lines.
    """
    columns, height = min(columns, len(images)), round(width * images[0].shape[0] / images[0].shape[1])
    rows = [captions[first : first + columns] for first in range(0, len(images), columns)]
    heights = [height + LINE_HEIGHT * (1 + max(text.count("\n") for text in row)) + GAP for row in rows]
    tops = list(itertools.accumulate(heights, initial=LINE_HEIGHT if title else 0))
    length = max(columns * (width + GAP) - GAP, math.ceil(_font().getlength(title)))
    whole = Image.new("RGB", (length, tops[-1] - GAP), PAPER)
    _write(whole, title, whole.width // 2, LINE_HEIGHT // 2, length)
    for number, (image, caption) in enumerate(zip(images, captions, strict=True)):
        left, top = number % columns * (width + GAP), tops[number // columns]
        whole.paste(_resized(image, width, height), (left, top))
        for line, text in enumerate(caption.split("\n")):
            _write(whole, text, left + width // 2, top + height + LINE_HEIGHT * line + LINE_HEIGHT // 2, width)
    return whole


def _resized(image: Float[Tensor, "h w 3"], width: int, height: int) -> Image.Image:
    """Resize an image by repeating or averaging pixels."""
    pixels = Image.fromarray(to_8bit(image).cpu().numpy())
    return pixels.resize((width, height), Image.Resampling.NEAREST if width >= pixels.width else Image.Resampling.BOX)


def _font(size: float = TEXT_SIZE) -> ImageFont.FreeTypeFont:
    import matplotlib

    # Pillow's own font lacks signs such as ≥ and ↑, which the font of matplotlib has.
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def _write(image: Image.Image, text: str, x: int, y: int, width: int) -> None:
    """Write a text around a centre, in smaller letters if the text is wider than `width`."""
    size = TEXT_SIZE * min(1.0, width / max(_font().getlength(text), 1))
    ImageDraw.Draw(image).text((x, y), text, fill=INK, font=_font(size), anchor="mm")


def magma(values: Float[Tensor, "H W"], limit: float) -> Float[Tensor, "H W 3"]:
    """Map values to the colours of matplotlib's magma: from black at 0 to pale yellow at `limit` and above.

    The limit is fixed and not fitted to the values, so that images can be compared.

    Args:
        values: non-negative values; NaN becomes grey.
        limit: value at the end of the scale.

    Returns:
        sRGB, float32.
    """
    if not limit > 0:
        raise NerfroError(f"limit={limit} of a colour scale is not allowed; give a positive number")
    import matplotlib

    num_colours = 256
    table = torch.from_numpy(matplotlib.colormaps["magma"](range(num_colours))[:, :3]).float()
    values = values.detach().cpu().float()
    index = (values.nan_to_num() / limit * (num_colours - 1)).round().clamp(0, num_colours - 1)
    return torch.where(values.isnan()[..., None], torch.tensor(EMPTY) / 255, table[index.long()])
