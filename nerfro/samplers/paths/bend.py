"""Exit rays and paths of rays through a medium, without a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.geometry.mesh import load_mesh
from nerfro.media.base import Medium
from nerfro.media.body_settings import make_bodies
from nerfro.registry.registration import discover, find
from nerfro.samplers.paths.snell import Snell
from nerfro.samplers.paths.thin_walls import warn_of_thin_walls
from nerfro.samplers.paths.traced_file import leave_box, make_rays

# Margin of air around the body in voxels; the grid needs at least two.
_MARGIN = 4


class Bent(NamedTuple):
    """Exit rays at the box around the body, in CPU memory.

    Attributes:
        positions: exit positions in world units, in the type of the origins; paths are computed in single precision.
        directions: unit exit directions.
        lengths: lengths of the paths from the origins, world units.
        hit: whether each ray met the body.
    """

    positions: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    lengths: Float[Tensor, "R"]
    hit: Bool[Tensor, "R"]


def bend(
    mesh: str | Path,
    ior: float,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    interface: Literal["mesh", "sdf"] = "mesh",
    resolution: int = 128,
) -> Bent:
    """Trace rays through a body of constant index by Snell's law, including total reflection.

    Args:
        mesh: file of a closed triangle mesh in world units, in any format that trimesh reads.
        ior: refractive index of the body; the index outside is 1.
        origins, directions: rays [R, 3] in the world of the mesh; directions need not have unit length.
        interface: `mesh` traces the triangles, `sdf` a smooth surface; see `sampler/path=snell`.
        resolution: number of vertices along each side of the grid of signed distances, at least 10.

    Returns:
        Exit positions, exit directions and path lengths.

    Raises:
        NerfroError: the mesh cannot be read or is open, the rays are not [R, 3] finite numbers, or the resolution is
            less than 10.
    """
    if resolution <= 2 * _MARGIN + 1:
        raise NerfroError(f"resolution={resolution} is not allowed; give at least {2 * _MARGIN + 2}")
    starts, towards = _checked_rays(origins, directions)
    low, high = load_mesh(resolve_path(mesh)).bounds
    margin = (high - low).max() * _MARGIN / (resolution - 1 - 2 * _MARGIN)
    low, high = (low - margin).tolist(), (high + margin).tolist()
    medium = make_bodies(str(mesh), ior, resolution, low, high)
    sampler = Snell(interface)
    warn_of_thin_walls(sampler, medium)
    path = sampler(make_rays(starts, towards, medium, 0.0, None), medium)
    positions, path_lengths = leave_box(path, medium)
    positions = (positions + torch.from_numpy(medium.origin)).to(starts)
    return Bent(positions, path.exit_directions, path_lengths, path.refracted)


def polylines(
    medium: Medium,
    origins: ArrayLike | Tensor,
    directions: ArrayLike | Tensor,
    length: float | None = None,
    interface: Literal["mesh", "sdf"] = "sdf",
) -> list[np.ndarray]:
    """Trace rays through a medium, and return the vertices of the paths, for example for a plot.

    Args:
        medium: bodies, traced by Snell's law, or a medium with a continuous index, traced by the ray equation.
        origins, directions: rays [R, 3], world units; directions need not have unit length.
        length: length of the paths, world units; bent paths end outside of the medium. By default, paths end well
            beyond the medium.
        interface: `mesh` traces the triangles of bodies, `sdf` smooth surfaces; see `sampler/path=snell`.

    Returns:
        One array of vertices [S, 3] for each ray.

    Raises:
        NerfroError: the rays are not [R, 3] finite numbers.
    """
    rays = make_rays(*_checked_rays(origins, directions), medium, 0.0, length)
    if medium.bodies is not None:
        path = Snell(interface)(rays, medium)
    else:
        discover()  # the sampler is a plugin
        path = find("sampler/path", "eikonal").cls()(rays, medium)
    vertices = zip(path.positions.numpy() + medium.origin, path.s.numpy(), strict=True)
    # All rows have the same length and repeat the last vertex.
    return [positions[np.diff(s, prepend=-1.0) > 0] for positions, s in vertices]


def _checked_rays(
    origins: ArrayLike | Tensor, directions: ArrayLike | Tensor
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Convert rays to tensors with unit directions."""
    starts, towards = (torch.as_tensor(np.asarray(values)) for values in (origins, directions))
    starts, towards = (values if values.is_floating_point() else values.double() for values in (starts, towards))
    if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.shape != towards.shape or not len(starts):
        raise NerfroError(f"origins {list(starts.shape)} and directions {list(towards.shape)} must both be [R, 3]")
    lengths = torch.linalg.vector_norm(towards, dim=-1)
    if not (torch.isfinite(starts).all() and torch.isfinite(lengths).all() and (lengths > 0).all()):
        raise NerfroError("origins and directions must be finite numbers, and no direction zero; correct them")
    return starts, functional.normalize(towards, dim=-1)
