"""Readers of image and mask files: 8 or 16 bits per channel in sRGB, and floating point or raw in linear light.

Depths, from images or from points of COLMAP, become arc lengths, the map `depth` of `Views`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy
import torch
from jaxtyping import Float, Float32, UInt8, UInt16
from PIL import Image
from torch import Tensor

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError, optional
from nerfro.core.light import encode_photograph, to_linear
from nerfro.files.images import is_float_tiff, radiance_size, read_16bit, read_radiance
from nerfro.files.reading import open_image, reading, reading_image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".jfif", ".webp", ".bmp", ".tif", ".tiff")
RAW_SUFFIXES = (
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2",
    ".srw", ".x3f",
)  # fmt: skip
VIEW_SUFFIXES = (*IMAGE_SUFFIXES, ".exr", ".hdr", *RAW_SUFFIXES)  # of photographs, but not of masks
Alpha = Literal["drop", "white", "black"]

# Integers of sRGB, or sRGB in floating point, which continues beyond 1 for photographs in linear light.
Levels = UInt8[np.ndarray, "H W *C"] | UInt16[np.ndarray, "H W *C"] | Float32[np.ndarray, "H W *C"]


def to_unit(levels: Levels) -> Float[np.ndarray, "H W *C"]:
    """Convert integer levels of 8 or 16 bits to numbers in [0, 1]; numbers in floating point are kept."""
    return levels if levels.dtype == np.float32 else levels.astype(np.float32) / np.iinfo(levels.dtype).max


def to_levels(values: Float[np.ndarray, "H W *C"]) -> UInt16[np.ndarray, "H W *C"]:
    """Round numbers in [0, 1] to 16-bit levels."""
    return np.rint(values * 65535).astype(np.uint16)


def read_levels(path: Path) -> Levels:
    """Read the 8- or 16-bit levels [H, W, C] of a file; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGBA)."""
    with open_image(path) as (image, bits):
        return _decode(path, image, bits)


def _decode(path: Path, image: Image.Image, bits: int) -> Levels:
    return _read_16bit(path, image) if bits > 8 else _read_8bit(image, bits)


def suffix_list(suffixes: Sequence[str]) -> str:
    """List suffixes for a message, without those of raw files, which are many."""
    names = ", ".join(suffix for suffix in suffixes if suffix not in RAW_SUFFIXES)
    return f"{names} and raw files" if RAW_SUFFIXES[0] in suffixes else names


def is_linear(path: Path) -> bool:
    """Return whether a photograph is in linear light: an .exr, .hdr or raw file, or a TIFF file in floating point."""
    return path.suffix.lower() in VIEW_SUFFIXES[len(IMAGE_SUFFIXES) :] or is_float_tiff(path)


def read_size(path: Path) -> tuple[int, int, int]:
    """Read width, height and bits per channel from the header of an image file; 32 bits for linear light."""
    if is_linear(path):
        with reading_image(path):
            return *(raw_size(path) if path.suffix.lower() in RAW_SUFFIXES else radiance_size(path)), 32
    with open_image(path) as (image, bits):
        return *image.size, bits


def _read_8bit(image: Image.Image, bits: int) -> UInt8[np.ndarray, "H W C"]:
    if image.mode == "P" and image.palette is None:
        raise OSError("it has no palette")
    # PNG files may state one colour that is transparent. Pillow scales grey levels to 8 bits, but this colour only if
    # it has one bit, and not in all versions.
    if image.mode in ("1", "L") and "transparency" in image.info and bits < 8:
        colour = image.info["transparency"] * 255 // (2**bits - 1)
        image = image.convert("L")
        image.info["transparency"] = min(colour, 255)
    if image.mode not in ("L", "LA", "RGB", "RGBA") or "transparency" in image.info:
        grey, transparent = image.mode in ("1", "L"), image.has_transparency_data
        image = image.convert(("LA" if transparent else "L") if grey else "RGBA" if transparent else "RGB")
    levels = np.asarray(image)
    return levels.reshape(*levels.shape[:2], -1)


def _read_16bit(path: Path, image: Image.Image) -> UInt16[np.ndarray, "H W C"]:
    levels, transparent = read_16bit(path), image.info.get("transparency")
    if isinstance(transparent, int):  # OpenImageIO takes no grey level for transparent
        grey = levels[..., 0]
        return np.stack([grey, np.where(grey == transparent, 0, 65535).astype(np.uint16)], -1)
    return levels


def read_rgb(path: Path, alpha: Alpha) -> Levels:
    """Read the colours of an image. `drop` ignores transparency; `white` and `black` composite over this colour.

    Returns:
        Levels [H, W, 3]: 16 bits if the image was composited, otherwise the bits of the file; floating point for
        photographs in linear light, see `encode_photograph`.
    """
    if is_linear(path):
        return encode_photograph(_read_radiance(path, alpha))
    levels = read_levels(path)
    num_colours = 1 if levels.shape[-1] < 3 else 3
    rgb = levels[..., :num_colours]
    if alpha != "drop" and levels.shape[-1] > num_colours:
        opacity = to_unit(levels[..., num_colours:])
        rgb = to_levels(to_unit(rgb) * opacity + (1 - opacity) * (1.0 if alpha == "white" else 0.0))
    return np.broadcast_to(rgb, (*rgb.shape[:2], 3))


def _read_radiance(path: Path, alpha: Alpha) -> Float[np.ndarray, "H W 3"]:
    """Read a photograph in linear light; transparency is composited in linear light."""
    with reading_image(path):
        radiance = read_raw(path) if path.suffix.lower() in RAW_SUFFIXES else read_radiance(path)
        if not np.isfinite(radiance).all():
            raise OSError("some of its values are not finite")
    colours, opacity = radiance[..., :3], radiance[..., 3:]
    if alpha == "drop" or opacity.shape[-1] == 0:
        return colours
    return colours * opacity + (1 - opacity) * (1.0 if alpha == "white" else 0.0)


def read_mask(path: Path, labels: Sequence[int] | None = None) -> Levels:
    """Read the coverage [H, W] of each pixel by the object.

    Alpha is the coverage if it varies. In an image of labels, every label but the background is the object: labels are
    the colours of a palette image, and few levels that fill areas. Otherwise, a level is the coverage itself; of a
    coloured mask, the largest channel counts.

    Args:
        path: the mask.
        labels: labels of the object, as indices of a palette image or as grey levels of the file; None for all.
    """
    with open_image(path) as (image, bits):
        indices, palette = (np.array(image), image.getpalette()) if image.mode == "P" else (None, None)
        lossy = image.format in ("JPEG", "MPO", "WEBP")
        levels = _decode(path, image, bits)
    num_colours = 1 if levels.shape[-1] < 3 else 3
    colours, share, most = levels[..., :num_colours], levels[..., :num_colours].max(-1), np.iinfo(levels.dtype).max
    if labels is not None:
        if indices is None and num_colours == 3:
            raise NerfroError(f"mask {path} has colours, which have no labels; save it as a palette or grey image")
        stored = share // (255 // (2**bits - 1)) if bits < 8 else share
        return np.isin(stored if indices is None else indices, labels).astype(levels.dtype) * most
    if levels.shape[-1] > num_colours and np.ptp(levels[..., -1]) > 0:
        return levels[..., -1]
    if palette is not None and (colours != colours[..., :1]).any():
        # The background is black, or else the first colour.
        background = [0, 0, 0] if (share == 0).any() else palette[:3]
        return (colours != background).any(-1).astype(levels.dtype) * most
    return (share > 0).astype(levels.dtype) * most if _has_labels(share, lossy) else share


def _has_labels(levels: Levels, lossy: bool) -> bool:
    """Return whether grey levels are labels, with 0 as the background: there is only one label, or labels fill areas.

    Coverage between 0 and 1 occurs along the outline, where neighbouring pixels differ. Lossy compression fills areas
    with wrong levels.
    """
    present = np.flatnonzero(np.bincount(levels.ravel()))
    if lossy or len(present[present > 0]) == 1:
        return len(present[present > 0]) == 1
    inner = levels[1:-1, 1:-1]
    partial = (inner > 0) & (inner < np.iinfo(levels.dtype).max)
    if present[0] > 0 or len(present) > 64 or not partial.any():
        return False
    height, width = inner.shape
    offsets = [(row, column) for row in range(3) for column in range(3)]
    flat = np.all([levels[r : r + height, c : c + width] == inner for r, c in offsets], axis=0)
    return bool(flat[partial].mean() > 0.25)


def downscaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Return the two sides of an image after downscaling by a factor of 1 or more, rounded to whole pixels."""
    first, second = (max(1, round(side / factor)) for side in size)
    return first, second


def downscaled_levels(
    levels: Levels, size: tuple[int, int]
) -> UInt16[np.ndarray, "h w *C"] | Float32[np.ndarray, "h w *C"]:
    """Downscale an image by `area_mean`: integers in sRGB, photographs in linear light in linear light."""
    if levels.dtype == np.float32:
        return encode_photograph(area_mean(to_linear(levels), size))
    return to_levels(area_mean(to_unit(levels), size))


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
    return mean.clip(values.min(), values.max()).astype(np.float32)


def _coverage(count: int, fewer: int) -> scipy.sparse.csr_array:
    """Return weights [fewer, count] that average `count` samples of a line over `fewer` intervals of equal length."""
    edges = np.union1d(np.arange(count + 1) / count, np.arange(fewer + 1) / fewer)
    middle, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    places = (middle * fewer).astype(int), (middle * count).astype(int)
    return scipy.sparse.csr_array((length * fewer, places), shape=(fewer, count))


def read_raw(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Develop a raw photograph to linear radiance with the white balance that the camera has stored.

    The image has sRGB primaries, and is turned as the camera was held. The level at which the sensor saturates is 1 in
    all channels and equal in all photographs, because the brightness is not adapted to the content.

    Raises:
        NerfroError: rawpy is missing.
    """
    with _open(path) as raw:
        options = {"no_auto_bright": True, "adjust_maximum_thr": 0.0, "gamma": (1, 1), "output_bps": 16}
        levels = raw.postprocess(use_camera_wb=True, **options)
    # The conversion of colours rounds saturated levels to slightly less than the maximum, 65535.
    return np.where(levels >= 65500, np.float32(1), levels / np.float32(65535))


def raw_size(path: Path) -> tuple[int, int]:
    """Read width and height of the image of `read_raw` from the header of a raw photograph."""
    with _open(path) as raw:
        sizes = raw.sizes
    turned = sizes.flip in (5, 6)  # by a quarter
    return (sizes.iheight, sizes.iwidth) if turned else (sizes.iwidth, sizes.iheight)


def _open(path: Path) -> Any:
    rawpy = optional("rawpy", "capture", f"{path} needs rawpy", ", or convert the photographs to .exr or 16-bit PNG")
    return rawpy.imread(str(path))


DEPTH = "depth"  # name of the map


def read_depths(files: Sequence[Path | None], unit: float, cameras: Cameras) -> Float[Tensor, "V H W 1"]:
    """Read depths along the optical axis, and convert them to arc lengths of straight rays through the pixel centres.

    Each pixel takes the nearest depth of the file, because means across an edge belong to no surface.

    Args:
        files: one image (16 bits) or array (.npy) [H, W] per camera, in any resolution; None for a view without depths.
        unit: world units per level of a file.
        cameras: cameras of the views, with the lenses of the given resolution.

    Returns:
        Arc lengths in world units; 0 where a file has no measurement (0, or not finite).

    Raises:
        NerfroError: a file is missing or damaged, or is no image of one channel.
    """
    size = cameras.height, cameras.width
    depths = torch.zeros(len(files), *size, 1)
    for view, file in enumerate(files):
        if file is None:
            continue
        levels = _read(file)
        rows, columns = (
            ((np.arange(length) + 0.5) * stored / length).astype(int)
            for length, stored in zip(size, levels.shape, strict=True)
        )
        along_axis = torch.from_numpy(np.nan_to_num(levels[rows][:, columns], nan=0, posinf=0, neginf=0) * unit)
        cosine = -cameras.image_rays(view).directions @ cameras.camera_to_world[view, :, 2]
        depths[view] = (along_axis.clamp(min=0).float() / cosine.view(size))[..., None]
    return depths


def depths_of_points(points: Sequence[Float[np.ndarray, "_ 3"]], cameras: Cameras) -> Float[Tensor, "V H W 1"]:
    """Compute the distances from each camera to the 3-D points that it has observed.

    Args:
        points: points of each view, in the coordinates of the cameras.
        cameras: cameras of the views.

    Returns:
        Distance of the nearest point in each pixel, world units; 0 in pixels without a point.
    """
    height, width = cameras.height, cameras.width
    depths = torch.zeros(len(points), height, width, 1)
    for view, seen in enumerate(points):
        positions = torch.from_numpy(seen).float()
        pixels, along_axis = cameras.select([view]).project(positions)
        column, row = pixels[0].floor().long().unbind(-1)
        visible = (along_axis[0] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        lengths = (positions - cameras.camera_to_world[view, :, 3]).norm(dim=-1)[visible]
        index = (row * width + column)[visible]
        nearest = torch.full((height * width,), torch.inf).scatter_reduce(0, index, lengths, "amin")
        depths[view] = torch.where(nearest.isfinite(), nearest, 0.0).view(height, width, 1)
    return depths


def _read(file: Path) -> Float[np.ndarray, "H W"]:
    if file.suffix.lower() == ".npy":
        with reading(file, "depths ", advice="write a NumPy array [H, W]"):
            levels = np.load(file, allow_pickle=False)
    else:
        levels = read_levels(file)
    levels = levels[..., 0] if levels.ndim == 3 and levels.shape[-1] == 1 else levels
    if levels.ndim != 2 or levels.dtype.kind not in "uif":
        raise NerfroError(f"depths {file} have the shape {list(levels.shape)}; write one number for each pixel, [H, W]")
    return levels.astype(np.float64)
