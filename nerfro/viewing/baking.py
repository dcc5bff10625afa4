"""A model as the arrays that a browser traces: signed distances, the sky as a cube, and what is inside as a volume."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from nerfro.boundaries.base import Boundary
from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.errors import NerfroError
from nerfro.kernels.tolerances import MIN_SEARCH_STEP
from nerfro.light import to_srgb
from nerfro.media.analytic import Vacuum
from nerfro.media.base import Medium
from nerfro.media.sdf_grid import BLOCK, SdfGrid
from nerfro.media.solid import Solid
from nerfro.models.base import NerfModel
from nerfro.types import Exits
from nerfro.viewing import packing
from nerfro.viewing.volume import UNSEEN, Volume

# Distances are kept up to this many cells from the surface, where the spline that is its zero level reads them; beyond,
# rays jump by the blocks' clearance.
_BAND = 3.5
_GRID_OF_ANALYTIC = 128  # vertices a side, where a medium has no grid of its own
_SKY_SIZE = 256  # texels along a cube's side, where the boundary is no texture
_SOLID = 30.0  # optical depth of a cell, at most
_BRICK = 8  # voxels a side of what is skipped where it is empty
_CHUNK = 2**16  # texels asked for at once


@dataclass(frozen=True)
class Baked:
    """Some of a page's arrays, as pictures by name, and the numbers that belong to them."""

    facts: dict[str, Any]
    voxels: dict[str, UInt8[np.ndarray, "Z Y X C"]] = field(default_factory=dict)

    def packed(self, compression: int = 9) -> dict[str, str]:
        """The arrays as `data:` addresses."""
        return {name: packing.pack(voxels, compression) for name, voxels in self.voxels.items()}


def bake_surface(model: NerfModel) -> Baked:
    """The bodies on which rays bend, as the grid whose splines `samplers/snell_cpu.py` follows.

    Raises:
        NerfroError: the medium has no surface.
    """
    medium: Medium = model.medium
    if isinstance(medium, Vacuum):
        return Baked({"iors": [], "nested": False, "absorption": [], "vertices": [2, 2, 2], "low": [0, 0, 0],
                      "high": [1, 1, 1], "step": 1.0, "clearance": 1.0, "block": BLOCK, "shortest": 1.0,
                      "events": 0})  # fmt: skip
    if not isinstance(medium, Solid):
        raise NerfroError(
            f"an interactive page shows bodies with a surface, and the index of {type(medium).__name__} varies "
            "in space; render a film of this run, or train with medium=sdf_grid"
        )
    grid = medium if isinstance(medium, SdfGrid) else _on_grid(medium)
    coefficients = grid.coefficients.detach().cpu().double().numpy()
    low, high = grid.box.detach().cpu().double().numpy()
    vertices = np.array(coefficients.shape[1:])
    spacing = (high - low) / (vertices - 1)
    step = _BAND * float(spacing.max()) / 32767
    steps = np.clip(np.round(coefficients / step), -32767, 32767).astype(np.int64)
    clearance = grid.coarse_clearance.cpu().double().numpy()
    unit = max(float(clearance.max()), 1e-9) / 255
    absorbed = getattr(medium, "absorption", None)
    absorption = absorbed.detach() if isinstance(absorbed, Tensor) else torch.zeros(len(medium.indices), 3)
    slices = np.concatenate([body.transpose(2, 1, 0) for body in steps])
    blocks = np.floor(clearance / unit + 1e-9).astype(np.uint8).transpose(2, 1, 0)
    return Baked(
        {
            "iors": [float(ior) for ior in medium.indices],
            "nested": medium.nested,
            "absorption": absorption.tolist(),
            "vertices": vertices.tolist(),
            "size": list(slices.shape[::-1]),
            "blocks": list(blocks.shape[::-1]),
            "low": low.tolist(),
            "high": high.tolist(),
            "step": step,
            "clearance": unit,
            "block": BLOCK,
            "shortest": MIN_SEARCH_STEP * float((high - low).min()),
            "events": getattr(model.path_sampler, "max_events", 16),
        },
        {"distances": packing.two_bytes(slices), "clearance": blocks[..., None]},
    )


def _on_grid(medium: Solid) -> SdfGrid:
    """A closed-form medium as one of distances on a grid."""
    axes = (torch.linspace(float(low), float(high), _GRID_OF_ANALYTIC) for low, high in medium.box.T)
    places = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).to(medium.box)
    with torch.no_grad():
        distances = torch.stack([medium.signed_distances(plane)[0] for plane in places]).movedim(-1, 0)
    return SdfGrid.from_distances(distances.contiguous(), medium.box, medium.indices.tolist(), medium.shell)


@torch.inference_mode()
def bake_sky(boundary: Boundary, device: torch.device) -> Baked:
    """Radiance at the texels of a cube in OpenGL's order, equally wide in angle; seen from the middle of all."""
    size = boundary.levels.resolutions[-1] if isinstance(boundary, EnvironmentMap) else _SKY_SIZE
    directions = cube_directions(size).to(device)
    radiance = torch.cat([boundary(Exits(some)).float().cpu() for some in directions.split(_CHUNK)])
    upper, rest = packing.shared_exponent(radiance.view(6, size, size, 3).double().numpy())
    return Baked({"size": size}, {"sky": upper, "sky_exponent": rest})


def cube_directions(size: int) -> Float[Tensor, "T 3"]:
    """Unit directions of the texels by face, row and column.

    A face's place (1, a, b) in [-1, 1] stands for the direction (1, tan(a pi / 4), tan(b pi / 4)). Orientations:
    OpenGL ES 3.0, table 3.21.
    """
    centres = ((torch.arange(size) + 0.5) / size * 2 - 1) * (math.pi / 4)
    t, s = torch.meshgrid(centres.tan(), centres.tan(), indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return F.normalize(torch.stack([torch.stack(face, -1) for face in faces]), dim=-1).view(-1, 3)


def volume_arrays(volume: Volume, colour: str) -> Baked:
    """What is inside, as the logarithm of its density and the root of its colour.

    Args:
        volume: with linear radiance.
        colour: what the model adds up, see `NerfModel`.
    """
    sides = volume.box[1] - volume.box[0]
    cell = float((sides / (torch.tensor(volume.density.shape) - 1)).min())
    thinnest, span = UNSEEN / cell, math.log(_SOLID / UNSEEN)
    levels = (volume.density.clamp(min=thinnest) / thinnest).log().div(span).clamp(max=1)
    rgb = (to_srgb(volume.rgb) if colour == "srgb" else volume.rgb).clamp(min=0)
    brightest = max(float(rgb.max()), 1e-6)
    content = torch.cat([(rgb / brightest).sqrt(), levels[..., None]], -1).mul(255).round().byte()
    slices = content.permute(2, 1, 0, 3).numpy()
    occupied = _bricks(slices[..., 3])
    return Baked(
        {
            "low": volume.box[0].tolist(),
            "high": volume.box[1].tolist(),
            "size": list(volume.density.shape),
            "bricks": list(occupied.shape[::-1]),
            "density": [math.log(thinnest), span],
            "brightest": brightest,
            "step": 0.7 * cell,
            "radius": volume.radius or 0.0,
        },
        {"colour": slices[..., :3], "density": slices[..., 3:], "occupied": occupied[..., None]},
    )


def _bricks(levels: UInt8[np.ndarray, "Z Y X"]) -> UInt8[np.ndarray, "z y x"]:
    """Whether anything is in equal parts of the grid, or at a vertex beside them that interpolation reads."""
    held = levels > 0
    for axis, count in enumerate(levels.shape):
        bounds = np.linspace(0, count - 1, math.ceil((count - 1) / _BRICK) + 1)
        parts = [
            held.take(range(math.floor(low), math.ceil(high) + 1), axis).any(axis) for low, high in pairwise(bounds)
        ]
        held = np.stack(parts, axis)
    return held.astype(np.uint8)
