"""What drawn pictures are made of: cells of one size, text, and colour scales."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.files.images import to_8bit

GAP = 6  # pixels between pictures
TEXT_SIZE = 14  # pixels
LINE_HEIGHT = 22  # pixels
PAPER, INK, EMPTY = (255, 255, 255), (25, 25, 25), (225, 225, 225)  # EMPTY: grey of what is not known


def paper(width: int, height: int) -> Image.Image:
    """A white picture."""
    return Image.new("RGB", (width, height), PAPER)


def fit(picture: Float[Tensor, "h w 3"] | None, width: int, height: int) -> Image.Image:
    """A picture at a size: enlarged by repeating pixels, reduced by averaging; grey where there is none."""
    if picture is None:
        cell = Image.new("RGB", (width, height), EMPTY)
        write(cell, "n/a", width // 2, height // 2)
        return cell
    image = Image.fromarray(to_8bit(picture).cpu().numpy())
    method = Image.Resampling.NEAREST if width >= image.width else Image.Resampling.BOX
    return image.resize((width, height), method)


def sheet(
    pictures: Sequence[Float[Tensor, "_ _ 3"]], captions: Sequence[str], width: int, columns: int, title: str
) -> Image.Image:
    """Pictures (sRGB) drawn `width` pixels wide in rows of at most `columns`, each over its caption, under a title."""
    columns, height = min(columns, len(pictures)), round(width * pictures[0].shape[0] / pictures[0].shape[1])
    pitch = height + LINE_HEIGHT + GAP
    whole = paper(columns * (width + GAP) - GAP, LINE_HEIGHT + -(-len(pictures) // columns) * pitch)
    write(whole, title, whole.width // 2, LINE_HEIGHT // 2)
    for place, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        left, top = place % columns * (width + GAP), LINE_HEIGHT + place // columns * pitch
        whole.paste(fit(picture, width, height), (left, top))
        write(whole, caption, left + width // 2, top + height + LINE_HEIGHT // 2)
    return whole


def write(image: Image.Image, text: str, x: int, y: int) -> None:
    """Write a text around a centre, moved inwards where it would leave the picture."""
    # Pillow's own font lacks signs such as ≥ and ↑; the one that matplotlib brings along has them.
    font = ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", TEXT_SIZE)
    draw = ImageDraw.Draw(image)
    half = draw.textlength(text, font=font) / 2
    draw.text((min(max(x, half), image.width - half), y), text, fill=INK, font=font, anchor="mm")


def colour_scale(width: int, height: int, title: str, limit: float) -> Image.Image:
    """A colour scale of error maps with its ends: without it the maps mean nothing."""
    cell = paper(width, height)
    length, thickness = round(0.8 * width), max(height // 12, 4)
    left, top = (width - length) // 2, (height - thickness) // 2
    ramp = magma(torch.linspace(0, limit, length).expand(thickness, length), limit)
    cell.paste(fit(ramp, length, thickness), (left, top))
    write(cell, title, width // 2, top - LINE_HEIGHT // 2)
    below = top + thickness + LINE_HEIGHT // 2
    write(cell, "0", left, below)
    write(cell, f"≥ {limit:g}", left + length, below)
    return cell


def magma(values: Float[Tensor, "H W"], limit: float) -> Float[Tensor, "H W 3"]:
    """Colours of matplotlib's magma: black at 0, through purple and orange, to pale yellow at `limit` and above.

    The scale is given and never fitted to the values, so that pictures can be compared.

    Values are non-negative; those that are NaN become grey. Colours are sRGB, float32.
    """
    if not limit > 0:
        raise NerfroError(f"the limit of a colour scale must be positive, got {limit}")
    num_colours = 256
    table = torch.from_numpy(matplotlib.colormaps["magma"](range(num_colours))[:, :3]).float()
    values = values.detach().cpu().float()
    index = (values.nan_to_num() / limit * (num_colours - 1)).round().clamp(0, num_colours - 1)
    return torch.where(values.isnan()[..., None], torch.tensor(EMPTY) / 255, table[index.long()])
