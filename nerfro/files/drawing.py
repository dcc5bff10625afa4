"""Elements of drawn images: cells of equal size, text, and the colours of error maps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.files.images import to_8bit

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
