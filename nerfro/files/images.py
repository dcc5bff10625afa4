"""Images of 8-bit sRGB, in which predictions are written and scored, deep images, and elements of drawn images.

Images with 16-bit or floating-point channels are read and written by OpenImageIO.
"""

from __future__ import annotations

import base64
import io
import itertools
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.files.reading import MAX_PIXELS, open_image

if TYPE_CHECKING:
    import OpenImageIO


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


def read_16bit(path: Path) -> UInt16[np.ndarray, "H W C"]:
    """Read the levels of a PNG or TIFF file with 16 bits per channel.

    Returns:
        Levels from 0 to 65535, not multiplied by alpha; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGBA).

    Raises:
        OSError: the file is truncated or corrupt, or its channels are not integers of 16 bits.
    """
    levels, _ = _read(path)
    if levels.dtype != np.uint16:
        raise OSError(f"its channels are {levels.dtype}; save it with 8 or 16 bits per channel")
    return levels


def is_float_tiff(path: Path) -> bool:
    """Return whether a file is a TIFF image of floating-point numbers, by convention linear light."""
    if path.suffix.lower() not in (".tif", ".tiff") or not path.is_file():
        return False
    import OpenImageIO

    try:
        image = _open(path)
    except OSError:
        return False
    return image.spec().format.basetype in (OpenImageIO.HALF, OpenImageIO.FLOAT, OpenImageIO.DOUBLE)


def radiance_size(path: Path) -> tuple[int, int]:
    """Read width and height from the header of a file of `read_radiance`.

    Raises:
        OSError: the file is corrupt, shows a part of its frame, or is to be turned for display.
    """
    spec = _open(path).spec()
    if path.suffix.lower() == ".exr" and spec.roi != spec.roi_full:
        raise OSError("its data window differs from its display window; save the whole frame")
    if spec.get_int_attribute("Orientation", 1) != 1:
        raise OSError(f"it has orientation {spec.get_int_attribute('Orientation')}; save it with upright pixels")
    return spec.width, spec.height


def read_radiance(path: Path) -> Float[np.ndarray, "H W C"]:
    """Read linear RGB radiance from an OpenEXR (.exr), Radiance (.hdr) or floating-point TIFF file.

    Returns:
        Radiance, and alpha if the file has it, by which the radiance is not multiplied.

    Raises:
        OSError: the file is truncated or corrupt, or has no channels R, G and B.
    """
    pixels, names = _read(path)
    if names[:3] != ("R", "G", "B"):
        raise OSError(f"it has the channels {', '.join(names)}, but R, G and B are needed")
    radiance = pixels[..., : 4 if names[3:4] == ("A",) else 3].astype(np.float32)
    if path.suffix.lower() != ".hdr":
        return radiance
    # A mantissa m of 8 bits stands for the interval from m to m + 1 (Ward, Real Pixels, Graphics Gems II, 1991).
    # OpenImageIO returns its lower end, which is 0.25 % too dark on average, and this code returns its middle.
    brightest = radiance.max(-1, keepdims=True)
    half_step = np.ldexp(np.float32(1), np.frexp(brightest)[1] - 9)
    return np.where(brightest > 0, radiance + half_step, 0)


def write_radiance(path: Path, values: Float[np.ndarray, "H W C"]) -> None:
    """Write one or three channels as OpenEXR in single precision (.exr), or three as Radiance RGBE (.hdr)."""
    import OpenImageIO

    height, width, num_channels = values.shape
    spec = OpenImageIO.ImageSpec(width, height, num_channels, OpenImageIO.FLOAT)
    spec.channelnames = ("R", "G", "B") if num_channels == 3 else ("Y",)
    spec.attribute("compression", "zip")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, f"image{path.suffix.lower()}")
        output = OpenImageIO.ImageOutput.create(str(file))
        if output is None:
            raise OSError(OpenImageIO.geterror())
        written = output.open(str(file), spec) and output.write_image(np.ascontiguousarray(values, np.float32))
        if not (output.close() and written):
            reason = " ".join(output.geterror().split())
            raise NerfroError(f"cannot write {path}: {reason}; free some space, or set TMPDIR to another folder")
        write_atomically(path, file.read_bytes())


def _open(path: Path) -> OpenImageIO.ImageInput:
    """Open a file, whose pixels will not be multiplied by alpha."""
    import OpenImageIO

    configuration = OpenImageIO.ImageSpec()
    configuration.attribute("oiio:UnassociatedAlpha", 1)
    image = OpenImageIO.ImageInput.open(str(path), configuration)
    if image is None:
        raise OSError(OpenImageIO.geterror().partition("\n")[0])  # an error that is not retrieved is printed at the end
    return image


def _read(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the pixels [H, W, C] in the type of the file, and the names of the channels."""
    image = _open(path)
    if image.spec().width * image.spec().height > MAX_PIXELS:
        raise OSError(f"it has more than {MAX_PIXELS / 1e6:.0f} million pixels")
    pixels, error = image.read_image(format=image.spec().format), image.geterror()
    image.close()
    if pixels is None:
        raise OSError(error.partition("\n")[0])
    if pixels.dtype == np.uint16 and image.spec().get_int_attribute("tiff:PhotometricInterpretation", 1) == 0:
        pixels[..., 0] = 65535 - pixels[..., 0]  # white is zero, which OpenImageIO only converts for 8 bits
    alpha, is_associated = image.spec().alpha_channel, not image.spec().get_int_attribute("oiio:UnassociatedAlpha")
    if pixels.dtype == np.uint16 and alpha >= 0 and is_associated:
        colours = 65535 * pixels[..., :alpha].astype(np.float64) / pixels[..., alpha:].clip(1)
        pixels[..., :alpha] = np.rint(colours).clip(0, 65535)  # TIFF files may hold colours multiplied by alpha
    elif pixels.dtype.kind == "f" and alpha == 3 and is_associated:
        opacity = pixels[..., 3:4]
        pixels[..., :3] /= np.where(opacity > 0, opacity, 1)
    return pixels, tuple(image.spec().channelnames)
