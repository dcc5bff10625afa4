"""Conversion of a model to arrays that a browser traces: signed distances, a cube map of the sky, and a volume.

Arrays are encoded as PNG images in text, which browsers decode and which compress smooth arrays well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.errors import NerfroError
from nerfro.core.light import ColourSpace, to_srgb
from nerfro.core.types import Exits
from nerfro.files.images import data_uri
from nerfro.media.distance_grid import BLOCK
from nerfro.rendering import Renderer
from nerfro.viewing.trained_scene import absorption_of
from nerfro.viewing.volume import MIN_OPTICAL_DEPTH, Volume

# Format RGB9_E5: three mantissas with a common exponent (OpenGL ES 3.0, section 3.8.3.2).
_MANTISSA_BITS, _EXPONENT_BIAS, _MAX_EXPONENT = 9, 15, 31
_LARGEST = (1 - 0.5**_MANTISSA_BITS) * 2.0 ** (_MAX_EXPONENT - _EXPONENT_BIAS)


def pack(voxels: UInt8[np.ndarray, "Z Y X C"], compression: int = 9) -> str:
    """Encode one, two or three bytes per voxel as the data URI of an image whose tiles are the slices.

    The image is always RGB: some browsers change grey values for display, and multiply colours by alpha.
    """
    depth, height, width, channels = voxels.shape
    columns = math.ceil(math.sqrt(depth))
    rows = math.ceil(depth / columns)
    tiles = np.zeros((rows * columns, height, width, 3), np.uint8)
    tiles[:depth, ..., :channels] = voxels
    mosaic = tiles.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    return data_uri(mosaic, "PNG", compress_level=compression)


def two_bytes(steps: Int[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 2"]:
    """Encode integers from -32768 to 32767, plus 32768, as upper and lower byte."""
    raised = (steps + 2**15).astype(np.uint16)
    return np.stack([raised >> 8, raised & 255], -1).astype(np.uint8)


def shared_exponent(
    radiance: Float[np.ndarray, "*shape 3"],
) -> tuple[UInt8[np.ndarray, "*shape 3"], UInt8[np.ndarray, "*shape 1"]]:
    """Encode radiance as RGB9_E5: upper eight bits of the mantissas, and exponent (x 8) with the lowest bits."""
    clipped = np.clip(radiance, 0, _LARGEST)
    brightest = clipped.max(-1)
    smallest = 2.0 ** -(_EXPONENT_BIAS + 1)
    exponent = np.floor(np.log2(np.maximum(brightest, smallest))).astype(np.int64) + 1 + _EXPONENT_BIAS
    # Rounding may need one more bit.
    fits = np.round(brightest / _step_size(exponent)) < 2**_MANTISSA_BITS
    exponent = np.where(fits, exponent, exponent + 1)
    mantissa = np.round(clipped / _step_size(exponent)[..., None]).astype(np.int64)
    lowest = ((mantissa & 1) * [1, 2, 4]).sum(-1)
    return (mantissa >> 1).astype(np.uint8), (exponent * 8 + lowest).astype(np.uint8)[..., None]


def _step_size(exponent: Int[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the difference between neighbouring mantissas."""
    return 2.0 ** (exponent.astype(np.float64) - _EXPONENT_BIAS - _MANTISSA_BITS)


@dataclass(frozen=True)
class Baked:
    """Arrays of a page by name, and the metadata with which the page reads them."""

    metadata: dict[str, Any]
    voxels: dict[str, UInt8[np.ndarray, "Z Y X C"]] = field(default_factory=dict)

    def packed(self, compression: int = 9) -> dict[str, str]:
        """Encode the arrays as data URIs."""
        return {name: pack(voxels, compression) for name, voxels in self.voxels.items()}


def bake_surface(renderer: Renderer) -> Baked:
    """Convert the refractive bodies to the grid of splines that `samplers/paths/snell_cpu.py` traces.

    Raises:
        NerfroError: the medium has no surface.
    """
    medium, sampler = renderer.scene.medium, renderer.path_sampler
    if medium.is_vacuum:
        return Baked({"iors": [], "dispersion": [], "nested": False, "absorption": [], "numVertices": [2, 2, 2],
                      "low": [[0, 0, 0]], "high": [[1, 1, 1]], "distanceUnits": [1.0], "clearanceUnits": [1.0],
                      "blockCells": BLOCK, "minStep": 1.0, "maxEvents": 0})  # fmt: skip
    bodies = medium.bodies
    if bodies is None:
        raise NerfroError(
            f"an interactive page shows bodies with a surface, and the index of {type(medium).__name__} varies "
            "in space; render a film of this run, or train with medium=sdf_grid"
        )
    # The page traces paths as `Snell` does, with the default settings if the model has another path sampler, but:
    # - Light splits only at the first event, also with `branches: all`. Both parts are followed, whatever their weight.
    # - Surfaces are always the zero levels of signed distances, also with `interface: mesh`.
    # - Each colour channel is traced at one wavelength.
    wavelengths = np.reshape(sampler.wavelengths, (3, -1))
    colours = wavelengths[:, wavelengths.shape[1] // 2].tolist()  # the middle band of each channel
    solids, count = bodies.packed(), len(bodies.grids)
    spacing = 1 / solids.inverse_spacing
    # The B-spline of the surface reads distances up to 3.5 cells from the surface. Farther away, rays advance by the
    # clearance of the blocks.
    distance_units = 3.5 * spacing.max(1) / 32767
    clearance = np.stack([grid.coarse_clearance().double().numpy() for grid in bodies.grids])
    clearance_units = clearance.max((1, 2, 3)).clip(min=1e-9) / 255
    coefficients = solids.coefficients.reshape(count, *solids.shape[0]).astype(np.float64)
    # The grids of all bodies follow each other along z.
    slices = np.concatenate(
        [np.round(coefficients[body] / distance_units[body]).transpose(2, 1, 0) for body in range(count)]
    )
    slices = slices.clip(-32767, 32767).astype(np.int64)
    blocks = np.concatenate(
        [np.floor(clearance[body] / clearance_units[body] + 1e-9).transpose(2, 1, 0) for body in range(count)]
    )
    return Baked(
        {
            "iors": [float(ior) for ior in medium.indices],
            "dispersion": [[body.dispersion_at(colour) for colour in colours] for body in bodies.materials],
            "nested": bodies.nested,
            "absorption": absorption_of(renderer.scene).tolist(),
            "numVertices": solids.shape[0].tolist(),
            "gridSize": list(slices.shape[::-1]),
            "clearanceSize": list(blocks.shape[::-1]),
            "low": solids.low.tolist(),
            "high": solids.high.tolist(),
            "distanceUnits": distance_units.tolist(),
            "clearanceUnits": clearance_units.tolist(),
            "blockCells": BLOCK,
            "minStep": float(solids.min_step.min()),
            "maxEvents": sampler.max_events,
        },
        {"distances": two_bytes(slices), "clearance": blocks[..., None].astype(np.uint8)},
    )


@torch.inference_mode()
def bake_sky(background: Background, device: torch.device) -> Baked:
    """Evaluate the background radiance at the texels of a cube map, seen from the centre of the scene."""
    size = background.face_resolution
    directions = cube_directions(size).to(device)
    radiance = torch.cat([background(Exits(chunk)).float().cpu() for chunk in directions.split(2**16)])
    upper, rest = shared_exponent(radiance.view(6, size, size, 3).double().numpy())
    return Baked({"size": size}, {"sky": upper, "sky_exponent": rest})


def cube_directions(size: int) -> Float[Tensor, "T 3"]:
    """Compute the unit directions of the texels of a cube map by face, row and column.

    The texels of a face are equally wide in angle: position (1, a, b) in [-1, 1] stands for the direction
    (1, tan(a pi / 4), tan(b pi / 4)). The orientations of the faces are those of OpenGL ES 3.0, table 3.21.
    """
    centres = ((torch.arange(size) + 0.5) / size * 2 - 1) * (math.pi / 4)
    t, s = torch.meshgrid(centres.tan(), centres.tan(), indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return F.normalize(torch.stack([torch.stack(face, -1) for face in faces]), dim=-1).view(-1, 3)


def bake_volume(volume: Volume, colour_space: ColourSpace) -> Baked:
    """Convert a volume to bytes: the logarithm of the density, and the square root of the colour.

    Args:
        volume: samples of the radiance field, with linear radiance.
        colour_space: space in which the model adds up the radiance of a ray.
    """
    sides = volume.space.box[1] - volume.space.box[0]
    cell = float((sides / (torch.tensor(volume.density.shape) - 1)).min())
    min_density, span = MIN_OPTICAL_DEPTH / cell, math.log(30.0 / MIN_OPTICAL_DEPTH)
    levels = (volume.density.clamp(min=min_density) / min_density).log().div(span).clamp(max=1)
    radiance = to_srgb(volume.radiance) if colour_space is ColourSpace.SRGB else volume.radiance
    radiance = radiance.clamp(min=0)
    max_radiance = max(float(radiance.max()), 1e-6)
    content = torch.cat([(radiance / max_radiance).sqrt(), levels[..., None]], -1).mul(255).round().byte()
    slices = content.permute(2, 1, 0, 3).numpy()
    occupied = _occupied_bricks(slices[..., 3])
    return Baked(
        {
            "low": volume.space.box[0].tolist(),
            "high": volume.space.box[1].tolist(),
            "size": list(volume.density.shape),
            "occupiedSize": list(occupied.shape[::-1]),
            "logDensity": [math.log(min_density), span],
            "maxRadiance": max_radiance,
            "marchStep": 0.7 * cell,
            "contractionRadius": volume.space.radius,
        },
        {"colour": slices[..., :3], "density": slices[..., 3:], "occupied": occupied[..., None]},
    )


def _occupied_bricks(levels: UInt8[np.ndarray, "Z Y X"]) -> UInt8[np.ndarray, "z y x"]:
    """Mark the bricks of a grid that have a nonzero vertex, inside or among the neighbours used for interpolation."""
    occupied = levels > 0
    for axis, count in enumerate(levels.shape):
        # Bricks of 8 voxels per side are skipped if they are empty.
        bounds = np.linspace(0, count - 1, math.ceil((count - 1) / 8) + 1)
        bricks = [
            occupied.take(range(math.floor(low), math.ceil(high) + 1), axis).any(axis) for low, high in pairwise(bounds)
        ]
        occupied = np.stack(bricks, axis)
    return occupied.astype(np.uint8)
