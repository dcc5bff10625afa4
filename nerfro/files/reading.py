"""Readers of untrusted files: images, JSON documents, arrays, and configurations of runs.

Decoders raise nearly any exception on a damaged file, allocate what a header asks for, and wait at a pipe. Therefore
these readers accept regular files of bounded size, and convert any error to one line.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import stat
import struct
import threading
import unicodedata
import warnings
import zipfile
from collections.abc import Iterator
from numbers import Real
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np
import yaml
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from PIL import ExifTags, Image, TiffImagePlugin, UnidentifiedImageError

from nerfro.core.errors import NerfroError
from nerfro.core.trust import require_bounded_yaml

# Pixels of the largest image, 134 million; bytes of the largest JSON document, and of all arrays of a file in memory.
MAX_PIXELS, MAX_JSON_BYTES, MAX_ARRAY_BYTES = 2**27, 2**27, 2**31

_AGAIN = "copy or export it again"
# Headers of 16-bit grey TIFF files with alpha, which Pillow does not know. OpenImageIO decodes their pixels.
TiffImagePlugin.OPEN_INFO.update(
    {(order, grey, (1,), 1, (16, 16), (2,)): ("LA", "LA;16B") for order in (b"II", b"MM") for grey in (0, 1)}
)
# Python's warning filters belong to all threads.
_filters = threading.Lock()


@contextlib.contextmanager
def reading(
    path: Path, what: str = "", trouble: str = "cannot be read", advice: str = _AGAIN, missing: str = "check the path"
) -> Iterator[None]:
    """Require a regular file, and convert any error about its content to one line.

    Args:
        path: the file.
        what: word before the path in the message, with a space.
        trouble, advice: middle and end of the message, around the reason.
        missing: advice for a file that does not exist.

    Raises:
        NerfroError: the file does not exist, is a pipe, a device or a folder, or reading it raised an exception.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise NerfroError(f"{what}{path} is not a regular file; give a file on a disk")
        yield
    except NerfroError:
        raise
    except FileNotFoundError as error:
        raise NerfroError(f"{what}{path} does not exist; {missing}") from error
    except Exception as error:
        strerror = error.strerror if isinstance(error, OSError) else None
        reason = strerror or str(error).strip().split("\n", 1)[0] or type(error).__name__
        raise NerfroError(f"{what}{path} {trouble} ({reason}); {advice}") from error


def reading_image(path: Path) -> contextlib.AbstractContextManager[None]:
    """Return the context `reading` for a photograph or a mask."""
    return reading(path, "image ", missing="restore it or remove its frame")


@contextlib.contextmanager
def open_image(path: Path, upright: bool = True) -> Iterator[tuple[Image.Image, int]]:
    """Open an image file, and yield it with the bits per channel of the file, of which Pillow silently keeps 8.

    Args:
        path: the file.
        upright: whether to refuse an EXIF orientation.

    Raises:
        NerfroError: the file is missing or damaged, has more than `MAX_PIXELS` pixels, or has an EXIF orientation.
    """
    with reading_image(path), path.open("rb") as file:
        with _filters, warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `MAX_PIXELS` is stricter
            try:
                image = Image.open(file)
                too_large = math.prod(image.size) > MAX_PIXELS
            except UnidentifiedImageError as error:
                raise OSError(
                    "it is not an image of a readable type; convert EXR, HEIC and raw files to PNG or JPEG"
                ) from error
            except Image.DecompressionBombError:
                too_large = True
        if too_large:
            raise NerfroError(f"image {path} has more than {MAX_PIXELS / 1e6:.0f} million pixels; downscale the image")
        with image:
            if image.format == "PNG" and _metadata_follow_pixels(file):
                image.load()  # reads them
            if upright:
                _require_upright(image, path)
            yield image, _bits(image, file)


def _bits(image: Image.Image, file: BinaryIO) -> int:
    if image.format == "PNG":
        position = file.tell()
        file.seek(24)
        (bits,) = file.read(1)
        file.seek(position)
        return bits
    if isinstance(image, TiffImagePlugin.TiffImageFile):
        return max(8, *image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, (8,)))
    return 8


def _metadata_follow_pixels(file: BinaryIO) -> bool:
    """Require all chunks of a PNG file, and return whether EXIF or XMP data follow the pixels.

    Pillow decodes a file without its end, and reads what follows the pixels only after decoding.
    """
    position, kind, after_pixels, follows = file.tell(), b"", False, False
    file.seek(8)
    while kind != b"IEND":
        head = file.read(8)
        if len(head) < 8:
            raise OSError("the file is truncated")
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IDAT":
            after_pixels = True
        elif after_pixels:
            start = file.read(min(length, 17))
            length -= len(start)
            follows |= kind == b"eXIf" or start in (b"Raw profile type ", b"XML:com.adobe.xmp")
        file.seek(length, 1)
        if len(file.read(4)) < 4:  # checksum
            raise OSError("the file is truncated")
    file.seek(position)
    return follows


def orientation_of(image: Image.Image) -> int:
    """Return the EXIF orientation of an image, which may be in XMP data; 1 is upright."""
    # The method of PNG files would decode the pixels.
    return Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)


def _require_upright(image: Image.Image, path: Path) -> None:
    """Refuse an EXIF orientation, because it is unknown whether poses and masks refer to the rotated pixels."""
    orientation = orientation_of(image)
    if orientation in range(2, 9):
        raise NerfroError(
            f"image {path} has EXIF orientation {orientation}; rotate its pixels (magick mogrify -auto-orient), or "
            "remove the entry (exiftool -Orientation=) if the poses belong to the pixels as stored"
        )


def read_json(path: Path, unreadable: str) -> Any:
    """Read a JSON file in UTF-8, UTF-16 or UTF-32; `unreadable` is the advice for a file that cannot be opened."""
    # Python refuses very long integers. Infinity takes their place and is refused where the value is used.
    parse_int = lambda text: int(text) if len(text) < 300 else math.inf  # noqa: E731
    with reading(path, advice=unreadable, missing=unreadable):
        if path.stat().st_size > MAX_JSON_BYTES:
            raise NerfroError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB, the most for JSON; split it")
        content = path.read_bytes()
    with reading(path, trouble="is not valid JSON"):
        return json.loads(content, parse_int=parse_int)


def read_text(path: Path, advice: str, most_bytes: int = MAX_JSON_BYTES) -> str:
    """Read a text file in UTF-8, with or without a byte-order mark; `advice` is the end of the error message."""
    with reading(path, advice=advice, missing=advice):
        if path.stat().st_size > most_bytes:
            raise OSError(f"it is larger than {most_bytes >> 20} MiB")
        return path.read_text(encoding="utf-8-sig")


def parse_matrix(value: object, shapes: tuple[tuple[int, int], ...], where: str) -> Float[np.ndarray, "rows columns"]:
    """Convert nested lists or an array to a matrix of finite numbers that has one of the shapes."""
    allowed = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    numbers = np.array(value, dtype=object)  # NumPy alone takes `true` for 1
    if not all(isinstance(number, Real) and not isinstance(number, bool) for number in numbers.flat):
        raise NerfroError(f"{where} is not a matrix of numbers; give {allowed} numbers")
    matrix = numbers.astype(np.float64)
    if matrix.shape not in shapes:
        raise NerfroError(
            f"{where} has shape {'x'.join(map(str, matrix.shape)) or 'of a number'}; give {allowed} numbers"
        )
    if not np.isfinite(matrix).all():
        raise NerfroError(f"{where} holds NaN or infinite numbers; correct it or take the frame out")
    return matrix


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a JSON value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def load_arrays(path: Path, most_bytes: float = MAX_ARRAY_BYTES) -> dict[str, np.ndarray]:
    """Read a .npz of plain arrays without executing pickled code.

    Args:
        path: the file.
        most_bytes: size of all arrays in memory, which is checked before anything is unpacked.
    """
    with reading(path, trouble="is not a readable .npz of plain arrays", advice="make it again"):
        with zipfile.ZipFile(path) as archive:
            needed = sum(entry.file_size for entry in archive.infolist())
        if needed > most_bytes:
            limit = f"at most {most_bytes / 2**30:g} GiB are read"
            raise NerfroError(f"{path} holds {needed / 2**30:.1f} GiB of arrays, but {limit}; split the file")
        with np.load(path) as file:
            return {name: file[name] for name in file.files}


def load_array(path: Path) -> np.ndarray:
    """Read the numbers of a .npy without executing pickled code, in double precision."""
    with reading(path):
        if path.stat().st_size > MAX_ARRAY_BYTES:
            raise OSError(f"it is larger than {MAX_ARRAY_BYTES >> 30} GiB")
        array = np.load(path)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise NerfroError(f"{path} is not a .npy of numbers; {_AGAIN}")
        return array.astype(np.float64)


def unicode_forms(name: str) -> list[str]:
    """List the spellings of a name: as stated, composed, and decomposed, as macOS writes letters with accents."""
    return list(dict.fromkeys((name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD")))))


def as_spelled(folder: Path, name: str) -> Path:
    """Return the path of a file in the spelling of its name that exists, see `unicode_forms`; else as stated."""
    paths = [folder / form for form in unicode_forms(name)]
    return next((path for path in paths if os.path.isfile(path)), paths[0])  # False for a name that is too long


def same_content(one: Path, other: Path) -> bool:
    """Test whether two paths name files with the same bytes."""
    files = one, other
    if not all(os.path.isfile(file) for file in files):  # False for a name that is too long
        return False
    return one.stat().st_size == other.stat().st_size and one.read_bytes() == other.read_bytes()


def foreign_config(text: str, origin: Path) -> DictConfig:
    """Read the configuration of a run, which nerfro.train writes as plain values.

    Interpolations are refused: `${oc.env:...}` would copy the environment of this machine into a shared page.
    """
    require_bounded_yaml(text, origin)
    try:
        config = OmegaConf.create(text)
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, AssertionError) as error:
        reason = " ".join(str(error).split())
        raise NerfroError(f"{origin} is not the configuration of a run ({reason}); leave the run out") from error
    if not isinstance(config, DictConfig):
        raise NerfroError(f"{origin} is not the configuration of a run; leave the run out")
    interpolation = re.search(r".*\$\{.*", OmegaConf.to_yaml(config))
    if interpolation:
        raise NerfroError(f"{origin} contains an interpolation ({interpolation[0].strip()}); write the value instead")
    return config


def read_foreign_config(path: Path) -> DictConfig:
    """Read the configuration of a run from a file; see `foreign_config`."""
    return foreign_config(read_text(path, "repair it, or leave the run out"), path)
