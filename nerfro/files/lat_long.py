"""Lat-long images of the sky, and reading and writing of such files.

World z is up: the top row looks along +z, the centre of the image along +x, and the azimuth from +x to +y runs to the
left, so that a viewer inside sees the sky unmirrored. Blender's environment textures use the same convention.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.core.light import to_linear, to_srgb
from nerfro.files.images import read_16bit, read_radiance, save_png, write_radiance
from nerfro.files.reading import open_image, reading

_FORMATS = (".png", ".jpg", ".jpeg", ".hdr", ".exr")
_TEXELS_PER_TASK = 1 << 17


def directions(height: int) -> Float[Tensor, "H 2*H 3"]:
    """Compute the unit directions of the pixel centres of a lat-long image."""
    polar = (torch.arange(height) + 0.5) / height * math.pi
    azimuth = math.pi - (torch.arange(2 * height) + 0.5) / height * math.pi
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    return torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], dim=-1)


def sample(radiance: Float[Tensor, "H W 3"], where: Float[Tensor, "points 3"], width: int) -> Float[Tensor, "points 3"]:
    """Look up directions bilinearly in a lat-long image, averaged to at most `width` columns against aliasing."""
    image = radiance.permute(2, 0, 1)[None]
    if radiance.shape[1] > width:
        image = torch.nn.functional.interpolate(image, size=(width // 2, width), mode="area")
    # An additional column on each side closes the seam.
    image = torch.cat([image[..., -1:], image, image[..., :1]], dim=-1)
    columns = image.shape[-1] - 2
    u = (0.5 - torch.atan2(where[:, 1], where[:, 0]) / (2 * math.pi)) * columns + 1
    v = torch.acos(where[:, 2].clamp(-1, 1)) / math.pi
    grid = torch.stack([u / (columns + 2) * 2 - 1, v * 2 - 1], dim=-1)[None, None]
    sampled = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T


def envmap_texture(sky: Callable[[np.ndarray], np.ndarray], height: int, to_world: np.ndarray) -> np.ndarray:
    """Return the sky sampled at the texels of Mitsuba's `envmap`, float32 [H, 2H, 3].

    Mitsuba reads row j at the polar angle pi j / (H - 1), so the first and last rows are the poles, and column i at the
    azimuth 2 pi (i + 1/2) / W. Texels at edges of the sky are averages of several samples; other texels are one sample.
    `to_world` [3, 3] rotates the frame of the emitter (y up) to the world.
    """
    width = 2 * height

    def sample(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        theta, phi = np.broadcast_arrays(np.pi * rows / (height - 1), 2 * np.pi * (columns + 0.5) / width)
        local = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
        return sky(local @ to_world.T).astype(np.float32)

    def refined(texels: np.ndarray) -> np.ndarray:
        offsets = np.mgrid[-1:2, -1:2].reshape(2, 9) / 3
        return sample(texels[:, :1] + offsets[0], texels[:, 1:] + offsets[1]).mean(1)

    bands = np.array_split(np.arange(height), -(-height * width // _TEXELS_PER_TASK))
    with ThreadPoolExecutor() as pool:
        texture = np.concatenate(list(pool.map(lambda rows: sample(rows[:, None], np.arange(width)), bands)))
        right = np.abs(texture - np.roll(texture, -1, 1)).max(-1)
        below = np.pad(np.abs(np.diff(texture, axis=0)).max(-1), ((1, 1), (0, 0)))
        contrast = np.maximum.reduce([right, np.roll(right, 1, 1), below[:-1], below[1:]])
        edges = np.argwhere(contrast > 0.1)
        tasks = np.array_split(edges, -(-9 * len(edges) // _TEXELS_PER_TASK) or 1)
        texture[edges[:, 0], edges[:, 1]] = np.concatenate(list(pool.map(refined, tasks)))
    return texture


def load_lat_long(path: Path | str) -> Float[Tensor, "H 2*H 3"]:
    """Read a lat-long image as linear radiance; .hdr and .exr may exceed 1.

    Raises:
        NerfroError: the file is missing, damaged, of another format or shape, or has invalid radiance.
    """
    path = Path(path)
    suffix = _format(path)
    with reading(path, "the sky ", advice="write or copy it again", missing="correct background.image"):
        if suffix in (".hdr", ".exr"):
            radiance = read_radiance(path)[..., :3]
        else:
            with open_image(path) as (image, bits):
                levels = read_16bit(path) / 65535 if bits > 8 else np.array(image.convert("RGB")) / 255
            radiance = to_linear(levels[..., :3] if levels.shape[-1] > 2 else levels[..., :1].repeat(3, -1))
    height, width = radiance.shape[:2]
    if width != 2 * height:
        raise NerfroError(f"the sky {path} has {width}x{height} pixels; give an image that is twice as wide as high")
    if not (np.isfinite(radiance).all() and (radiance >= 0).all()):
        raise NerfroError(f"the sky {path} has radiance that is negative or not finite; write or copy it again")
    return torch.from_numpy(np.ascontiguousarray(radiance)).float()


def save_lat_long(path: Path | str, radiance: Float[Tensor, "H 2*H 3"]) -> None:
    """Write linear radiance to .hdr or .exr, or clipped 8-bit sRGB to .png."""
    path = Path(path)
    suffix = _format(path)
    if suffix == ".png":
        save_png(path, to_srgb(radiance).clamp(0, 1))
        return
    if suffix in (".hdr", ".exr"):
        write_radiance(path, radiance.float().numpy())
    else:
        raise NerfroError(f"a sky is not written as {suffix}, which loses detail; use .png, .hdr or .exr")


def _format(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise NerfroError(f"the sky {path} ends in '{suffix}'; allowed are {', '.join(_FORMATS)}")
    return suffix
