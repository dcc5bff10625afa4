"""The optics alone: where rays leave a body of glass."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from nerfro.errors import NerfroError
from nerfro.geometry.mesh import load_mesh
from nerfro.media.sdf_grid import SdfGrid
from nerfro.paths import resolve_path
from nerfro.samplers.snell import Snell
from nerfro.samplers.traced_file import leave_box, make_rays

# Voxels of air around the body; two are the least.
_AIR = 4


class Bent(NamedTuple):
    """Where rays leave the box around the body: for other programs, on the CPU."""

    positions: Float[Tensor, "R 3"]  # world units
    directions: Float[Tensor, "R 3"]  # unit
    lengths: Float[Tensor, "R"]  # of the paths up to there, world units
    hit: Bool[Tensor, "R"]  # whether the ray met the body


def bend(
    mesh: str | Path,
    ior: float,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    interface: Literal["mesh", "sdf"] = "mesh",
    resolution: int = 128,
) -> Bent:
    """Follow rays through a body of constant index by Snell's law, total reflection included, until they leave it.

    Args:
        mesh: file of a closed triangle mesh, world units, any format trimesh reads.
        ior: refractive index inside it; 1 outside.
        origins, directions: of the rays [R, 3], in the mesh's world; directions of any length but zero.
        interface: see `sampler/path=snell`; `mesh` for the triangles, `sdf` for a smooth surface, as of noisy hulls.
        resolution: vertices a side of the grid of distances.

    Raises:
        NerfroError: the mesh cannot be read or is open, or the rays are not [R, 3] finite numbers.
    """
    starts, towards = (torch.as_tensor(np.asarray(values), dtype=torch.float32) for values in (origins, directions))
    if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.shape != towards.shape or not len(starts):
        raise NerfroError(f"origins {list(starts.shape)} and directions {list(towards.shape)} must both be [R, 3]")
    lengths = torch.linalg.vector_norm(towards, dim=-1)
    if not (torch.isfinite(starts).all() and torch.isfinite(lengths).all() and (lengths > 0).all()):
        raise NerfroError("origins and directions must be finite numbers, and no direction zero; correct them")
    low, high = load_mesh(resolve_path(mesh)).bounds
    air = (high - low).max() * _AIR / (resolution - 1 - 2 * _AIR)
    medium = SdfGrid(str(mesh), ior, resolution=resolution, box_min=(low - air).tolist(), box_max=(high + air).tolist())
    rays = make_rays(starts, functional.normalize(towards, dim=-1), medium, 0.0, None)
    path = Snell(interface)(rays, medium)
    positions, path_lengths = leave_box(path, medium)
    return Bent(positions, path.exit_directions, path_lengths, path.refracted)
