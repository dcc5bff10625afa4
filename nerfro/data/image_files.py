"""Readers of image and mask files with 8 or 16 bits per channel."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import ExifTags, Image, TiffImagePlugin, UnidentifiedImageError
from scipy.sparse import csr_array

from nerfro.errors import NerfroError
from nerfro.files.deep_images import read_16bit

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
Alpha = Literal["drop", "white", "black"]
Levels = UInt8[np.ndarray, "H W *C"] | UInt16[np.ndarray, "H W *C"]


def to_unit(levels: Levels) -> Float[np.ndarray, "H W *C"]:
    """Convert integer levels of 8 or 16 bits to numbers in [0, 1]."""
    return levels.astype(np.float32) / np.iinfo(levels.dtype).max


def to_levels(values: Float[np.ndarray, "H W *C"]) -> UInt16[np.ndarray, "H W *C"]:
    """Round numbers in [0, 1] to 16-bit levels."""
    return np.rint(values * 65535).astype(np.uint16)


def read_levels(path: Path) -> Levels:
    """Read the 8- or 16-bit levels [H, W, C] of a file; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGBA)."""
    with _open(path) as (image, bits):
        return read_16bit(path) if bits > 8 else _read_8bit(image)


def read_size(path: Path) -> tuple[int, int, int]:
    """Read width, height and bits per channel from the header of an image file."""
    with _open(path) as (image, bits):
        return *image.size, bits


@contextlib.contextmanager
def _open(path: Path) -> Iterator[tuple[Image.Image, int]]:
    """Open an image file with Pillow; yield it with its bits per channel, of which Pillow silently keeps 8."""
    with _naming(path), path.open("rb") as file:
        header = file.read(25)
        file.seek(0)
        with Image.open(file) as image:
            _require_upright(image, path)
            bits = 8
            if image.format == "PNG":
                bits = max(bits, header[24])
            elif isinstance(image, TiffImagePlugin.TiffImageFile):
                bits = max(bits, *image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, (8,)))
            yield image, bits


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Convert errors about an unreadable file to a message that names the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise NerfroError(f"image {path} does not exist; restore it or remove its frame") from error
    except UnidentifiedImageError as error:
        raise NerfroError(f"image {path} cannot be read (it is not an image); copy or export it again") from error
    # Pillow reports a corrupt PNG as SyntaxError or ValueError.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise NerfroError(f"image {path} cannot be read ({error}); copy or export it again") from error


def _require_upright(image: Image.Image, path: Path) -> None:
    """Refuse an EXIF orientation, because it is unknown whether poses and masks refer to the rotated pixels."""
    # Pillow applies the orientation of TIFF files itself.
    orientation = image.getexif().get(ExifTags.Base.Orientation, 1) if "exif" in image.info else 1
    if orientation != 1:
        raise NerfroError(
            f"image {path} has EXIF orientation {orientation}; rotate its pixels (magick mogrify -auto-orient), or "
            "remove the entry (exiftool -Orientation=) if the poses belong to the pixels as stored"
        )


def read_exposure(path: Path) -> tuple[float | None, float | None, float | None]:
    """Read exposure time in seconds, f-number and ISO sensitivity from EXIF data; None for a missing value."""
    with _naming(path), Image.open(path) as image:
        tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    named = ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings
    time, number, sensitivity = (_positive(tags.get(tag)) for tag in named)
    return time, number, sensitivity


def _positive(value: object) -> float | None:
    """Convert an EXIF value to a positive number, or None if it is missing or invalid."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if 0 < number < float("inf") else None


def _read_8bit(image: Image.Image) -> UInt8[np.ndarray, "H W C"]:
    if image.mode not in ("L", "LA", "RGB", "RGBA"):
        image = image.convert("RGBA" if image.has_transparency_data else "L" if image.mode == "1" else "RGB")
    levels = np.asarray(image)
    return levels.reshape(*levels.shape[:2], -1)


def read_rgb(path: Path, alpha: Alpha) -> Levels:
    """Read the colours of an image. `drop` ignores transparency; `white` and `black` composite over this colour.

    Returns:
        Levels [H, W, 3]: 16 bits if the image was composited, otherwise the bits of the file.
    """
    levels = read_levels(path)
    num_colours = 1 if levels.shape[-1] < 3 else 3
    rgb = levels[..., :num_colours]
    if alpha != "drop" and levels.shape[-1] > num_colours:
        opacity = to_unit(levels[..., num_colours:])
        rgb = to_levels(to_unit(rgb) * opacity + (1 - opacity) * (1.0 if alpha == "white" else 0.0))
    return np.broadcast_to(rgb, (*rgb.shape[:2], 3))


def read_mask(path: Path) -> Levels:
    """Read the coverage [H, W] of each pixel by the object.

    Of a coloured mask, the largest channel counts. A mask with the levels 0 and 1 only is read as labels.
    """
    levels = read_levels(path)
    share = levels[..., : 1 if levels.shape[-1] < 3 else 3].max(-1)
    most = np.iinfo(levels.dtype).max
    return np.where(share > 0, most, 0).astype(levels.dtype) if share.max() < 1.5 / 255 * most else share


def downscaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Return the two sides of an image after downscaling by a factor of 1 or more, rounded to whole pixels."""
    first, second = (max(1, round(side / factor)) for side in size)
    return first, second


def area_mean(values: Float[np.ndarray, "H W *C"], size: tuple[int, int]) -> Float[np.ndarray, "h w *C"]:
    """Downscale an image to a size (height, width); each pixel becomes the mean of the area that it covers."""
    height, width = values.shape[:2]
    if size == (height, width):
        return values
    channels = values.shape[2:]
    if height % size[0] == 0 and width % size[1] == 0:
        blocks = values.reshape(size[0], height // size[0], size[1], width // size[1], *channels)
        return blocks.mean((1, 3), dtype=np.float32)
    rows = (_coverage(height, size[0]) @ values.reshape(height, -1)).reshape(size[0], width, -1)
    columns = _coverage(width, size[1]) @ rows.swapaxes(0, 1).reshape(width, -1)
    mean = columns.reshape(size[1], size[0], *channels).swapaxes(0, 1)
    return mean.clip(0, 1).astype(np.float32)


def _coverage(count: int, fewer: int) -> csr_array:
    """Return weights [fewer, count] that average `count` samples of a line over `fewer` intervals of equal length."""
    edges = np.union1d(np.arange(count + 1) / count, np.arange(fewer + 1) / fewer)
    middle, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    places = (middle * fewer).astype(int), (middle * count).astype(int)
    return csr_array((length * fewer, places), shape=(fewer, count))
