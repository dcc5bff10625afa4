"""Image files with 16-bit or floating-point channels, read and written by OpenImageIO."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt16

from nerfro.core.errors import NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.reading import MAX_PIXELS

if TYPE_CHECKING:
    import OpenImageIO


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
