"""Reading images and masks: every bit depth, checked, many at a time."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.files.png16 import decode_png16, is_png16

Alpha = Literal["drop", "white", "black"]
Read = Callable[[Path], Float[np.ndarray, "H W *C"]]


def read_levels(path: Path) -> Float[np.ndarray, "H W C"]:
    """Read an image file with 8 or 16 bits per channel, whichever it has.

    Returns:
        Values in [0, 1], float32; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGBA).

    Raises:
        NerfroError: the file is missing, truncated, corrupt or not an image of 8 or 16 bits.
    """
    try:
        content = path.read_bytes()
        if is_png16(content):
            return decode_png16(content).astype(np.float32) / 65535
        return _read_8bit(content, path)
    except FileNotFoundError as error:
        raise NerfroError(f"image {path} does not exist; restore it or take it out of the frames") from error
    except UnidentifiedImageError as error:
        raise NerfroError(f"image {path} cannot be read (it is no image); copy or export it again") from error
    # Pillow reports a corrupt PNG as SyntaxError or ValueError, and PngError is one.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise NerfroError(f"image {path} cannot be read ({error}); copy or export it again") from error


def _read_8bit(content: bytes, path: Path) -> Float[np.ndarray, "H W C"]:
    with Image.open(io.BytesIO(content)) as image:
        # Pillow reduces colour TIFF of more bits without a word, as it does PNG; tag 258 is BitsPerSample.
        deep_tiff = image.format == "TIFF" and max(image.tag_v2.get(258, (1,))) > 8
        if deep_tiff or image.mode in ("I", "F") or image.mode.startswith("I;"):
            raise NerfroError(f"image {path} has more than 8 bits per channel; save it as 8- or 16-bit PNG")
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            transparent = image.has_transparency_data
            image = image.convert("RGBA" if transparent else "L" if image.mode == "1" else "RGB")
        levels = np.asarray(image)
    return levels.reshape(*levels.shape[:2], -1).astype(np.float32) / 255


def read_rgb(path: Path, alpha: Alpha) -> Float[np.ndarray, "H W 3"]:
    """Read an image's colours.

    Args:
        path: an image with or without transparency.
        alpha: `drop` takes the colours as they are, `white` and `black` composite them over that colour.

    Raises:
        NerfroError: as `read_levels`.
    """
    levels = read_levels(path)
    num_colours = 1 if levels.shape[-1] < 3 else 3
    rgb = levels[..., :num_colours]
    if alpha != "drop" and levels.shape[-1] > num_colours:
        opacity = levels[..., num_colours:]
        rgb = rgb * opacity + (1 - opacity) * (1.0 if alpha == "white" else 0.0)
    return np.broadcast_to(rgb, (*rgb.shape[:2], 3))


def read_mask(path: Path) -> Float[np.ndarray, "H W"]:
    """Read the share of each pixel that the object covers; a mask whose levels are 0 and 1 only is taken as labels.

    Raises:
        NerfroError: as `read_levels`.
    """
    levels = read_levels(path)
    share = levels[..., : 1 if levels.shape[-1] < 3 else 3].max(-1)
    return (share > 0).astype(np.float32) if share.max() < 1.5 / 255 else share


def area_mean(values: Float[np.ndarray, "H W *C"], factor: int, path: Path) -> Float[np.ndarray, "h w *C"]:
    """Mean of each block of factor x factor pixels.

    Raises:
        NerfroError: the factor does not divide the sides.
    """
    height, width = values.shape[:2]
    if height % factor or width % factor:
        allowed = [n for n in range(1, 33) if height % n == 0 and width % n == 0]
        raise NerfroError(
            f"data.downscale={factor} does not divide the {width}x{height} pixels of {path}; "
            f"choose one of {', '.join(map(str, allowed))}"
        )
    if factor == 1:
        return values
    blocks = values.reshape(height // factor, factor, width // factor, factor, *values.shape[2:])
    return blocks.mean((1, 3), dtype=np.float32)


def read_stack(
    paths: Sequence[Path], read: Read, downscale: int, expected_size: tuple[int, int] | None = None
) -> Float[Tensor, "V H W *C"]:
    """Read images of one size side by side on all CPU cores.

    Args:
        paths: image files.
        read: reader of one file.
        downscale: side of the blocks of pixels that are averaged.
        expected_size: width and height in pixels before downscaling, where the data states them.

    Raises:
        NerfroError: a file cannot be read, has another size than expected or than the first, or does not divide.
    """
    first = read(paths[0])
    width, height = first.shape[1], first.shape[0]
    if expected_size is not None and expected_size != (width, height):
        raise NerfroError(
            f"image {paths[0]} has {width}x{height} pixels where {expected_size[0]}x{expected_size[1]} are expected; "
            "restore the right image or correct the transforms file"
        )
    stack = np.empty((len(paths), *area_mean(first, downscale, paths[0]).shape), np.float32)

    def read_into(index: int) -> None:
        path = paths[index]
        values = first if index == 0 else read(path)
        if values.shape != first.shape:
            raise NerfroError(
                f"image {path} has {values.shape[1]}x{values.shape[0]} pixels but {paths[0]} has {width}x{height}; "
                "all images of a split must have one size"
            )
        stack[index] = area_mean(values, downscale, path)

    # Decoding releases the interpreter's lock, so threads suffice.
    with ThreadPoolExecutor(min(len(paths), os.cpu_count() or 1)) as pool:
        futures = [pool.submit(read_into, index) for index in range(len(paths))]
        try:
            for future in futures:
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)
    return torch.from_numpy(stack)
