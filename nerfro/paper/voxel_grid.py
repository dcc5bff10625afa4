"""The medium of the paper: a mesh that is voxelized to occupancy fractions and smoothed (section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool3d

from nerfro.core.errors import NerfroError
from nerfro.files.cache import cached_arrays, content_hash
from nerfro.geometry.interpolation import neighbours, smooth, trilinear
from nerfro.geometry.mesh import local_origin, require_inside
from nerfro.geometry.occupancy import occupancy_fraction
from nerfro.geometry.signed_distance import distance_to_set
from nerfro.geometry.space import corners_of_box
from nerfro.kernels.available import require_bytes
from nerfro.kernels.constants import constant
from nerfro.kernels.operators import arrays
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.media.bodies import BYTES_PER_VERTEX, check_margin
from nerfro.media.surfaces import MeshSurface
from nerfro.registry.allowed import Positive, Resolution
from nerfro.registry.registration import register

# Part of the cache key. Increase it when the same mesh and settings give different fractions.
_VERSION = 1
# Inside tests along each side around a vertex.
_SUBSAMPLES = 4


@register("medium", "voxel_grid")
class VoxelGrid(Medium):
    """A grid of refractive index and gradient, computed from a mesh by supersampling and Gaussian smoothing (paper).

    n = 1 + (ior - 1) * smooth(occupancy), and grad n is the central difference of n on the grid. Both are interpolated
    trilinearly. Therefore the returned gradient is not the derivative of the returned n.

    Args:
        mesh: closed triangle mesh in world units, any format trimesh reads.
        ior: refractive index inside the mesh.
        resolution: vertices along each side of the grid; 64 to 512 are usual.
        box_min, box_max: corners of the grid, world units; the object needs a margin of air inside.
        smoothing_size: taps of the Gaussian kernel along each axis, odd; 0 switches smoothing off.
        smoothing_sigma: standard deviation of the kernel, voxels.
        accept_open_mesh: accept a mesh with holes; the majority of three axes decides which points are inside.
        cache: keep the occupancy in the cache folder.
    """

    table: Float[Tensor, "X Y Z 4"]  # n and grad n (per world unit) at each vertex
    # Lower bound of the distance to the next cell with grad n != 0, for any point of each cell, world units.
    clearance_grid: Float[Tensor, "x y z"]
    occupancy: Float[Tensor, "X Y Z"]  # fraction inside the mesh, before smoothing
    _on_host: tuple[Tensor, list[np.ndarray]] | None = None

    def __init__(
        self,
        mesh: str,
        ior: Positive = 1.5,
        resolution: Resolution = 128,
        box_min: Sequence[float] = (-1.5, -1.5, -1.5),
        box_max: Sequence[float] = (1.5, 1.5, 1.5),
        smoothing_size: Annotated[int, Ge(0), Le(99)] = 9,
        smoothing_sigma: Positive = 1.0,
        accept_open_mesh: bool = False,
        cache: bool = True,
    ) -> None:
        super().__init__()
        require_bytes(BYTES_PER_VERTEX * resolution**3, f"medium.resolution={resolution}")
        box = corners_of_box(box_min, box_max)
        loaded = MeshSurface(mesh, accept_open_mesh, "smooth").mesh
        # One voxel for the subsamples, one for the central difference, and the radius of the smoothing kernel.
        check_margin(loaded.bounds, box, resolution, 2 + smoothing_size // 2)
        self.origin = local_origin(loaded.vertices)
        box, loaded = box - self.origin, loaded.relative_to(self.origin)
        key = "occupancy_" + content_hash(_VERSION, loaded.vertices, loaded.faces, box, resolution, _SUBSAMPLES)
        occupancy = cached_arrays(
            key,
            # Multiples of 1/64 are exact in half precision.
            lambda: {"occupancy": occupancy_fraction(loaded, box, resolution, _SUBSAMPLES).astype(np.float16)},
            cache,
        )["occupancy"]
        require_inside(bool(occupancy.max() > 0.25))  # vertices on a flat mesh count as inside to some extent
        fractions, corners = torch.from_numpy(occupancy).float(), torch.from_numpy(box).float()
        self._set(fractions, corners, ior, smoothing_size, smoothing_sigma)

    @classmethod
    def from_occupancy(
        cls,
        occupancy: Float[Tensor, "X Y Z"],
        box: Float[Tensor, "2 3"],
        ior: float,
        size: int,
        sigma: float,
    ) -> VoxelGrid:
        """Make the medium from occupancy fractions.

        Args:
            occupancy: fractions in [0, 1] at the vertices of a grid; 0 at the border.
            box: lower and upper corner of the grid, world units.
            ior: refractive index inside the object.
            size: taps of the smoothing kernel along each axis.
            sigma: standard deviation of the smoothing kernel, voxels.
        """
        medium = cls.__new__(cls)
        Medium.__init__(medium)
        medium._set(occupancy, box, ior, size, sigma)
        return medium

    def _set(self, occupancy: Tensor, box: Tensor, ior: float, size: int, sigma: float) -> None:
        if occupancy.count_nonzero() > occupancy[1:-1, 1:-1, 1:-1].count_nonzero():
            raise NerfroError("the object touches the grid's border; enlarge medium.box_min and medium.box_max")
        self.ior, self.smoothing_size, self.smoothing_sigma = float(ior), int(size), float(sigma)
        # Grids are rebuilt from the mesh at every start and do not belong in checkpoints.
        self.register_buffer("occupancy", occupancy, persistent=False)
        self.register_buffer("box", box, persistent=False)
        n = 1 + (ior - 1) * smooth(occupancy, size, sigma)
        spacing = (box[1] - box[0]) / (torch.tensor(n.shape) - 1)
        table = torch.cat([n[..., None], gradient(n, spacing)], -1)
        self.register_buffer("table", table, persistent=False)
        self.register_buffer("clearance_grid", _clearance_of(table, spacing, box), persistent=False)

    @property
    def indices(self) -> Float[Tensor, "K"]:
        return torch.tensor([self.ior])

    def with_indices(self, indices: Float[Tensor, "K"]) -> VoxelGrid:
        smoothing = self.smoothing_size, self.smoothing_sigma
        return self.from_occupancy(self.occupancy.cpu(), self.box.cpu(), float(indices), *smoothing).to(self.box.device)

    @property
    def host_arrays(self) -> list[np.ndarray]:
        """Table and clearance grid in the memory of the host."""
        # The arrays of 256^3 vertices have 340 MB, so a copy from a GPU for each batch would be slow.
        if self._on_host is None or self._on_host[0] is not self.table:
            self._on_host = self.table, arrays(self.table, self.clearance_grid)
        return self._on_host[1]

    @property
    def spacing(self) -> Float[Tensor, "3"]:
        """Distance between neighbouring vertices, world units."""
        return (self.box[1] - self.box[0]) / (constant(self.table.shape[:3], self.box.device) - 1)

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Bounds of the occupied vertices, world units."""
        occupied = self.occupancy.nonzero()
        return self.box[0] + torch.stack([occupied.amin(0), occupied.amax(0)]) * self.spacing

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Interpolate the refractive index and its gradient (per world unit); n = 1 and grad n = 0 outside the box."""
        values = trilinear(self.table, self.box, positions)
        inside = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n = torch.where(inside, values[..., 0], 1.0)
        return n, torch.where(inside[..., None], values[..., 1:], 0.0)

    def clearance(self, positions: Vectors) -> Scalars:
        """Return the distance within which grad n is zero, world units."""
        grid = self.clearance_grid
        cell = ((positions - self.box[0]) / self.spacing).floor().long()
        x, y, z = torch.minimum(cell.clamp(min=0), constant(grid.shape, grid.device) - 1).unbind(-1)
        return grid[x, y, z]

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """Return half a voxel."""
        return (0.5 * self.spacing.min()).expand(directions.shape[:-1])


def gradient(values: Float[Tensor, "X Y Z"], spacing: Float[Tensor, "3"]) -> Float[Tensor, "X Y Z 3"]:
    """Return central differences, (next - previous) / 2h; replicated borders halve the gradient at the border."""
    parts = []
    for axis in range(3):
        before, after = neighbours(values, axis)
        parts.append((after - before) / (2 * spacing[axis]))
    return torch.stack(parts, -1)


def _clearance_of(
    table: Float[Tensor, "X Y Z 4"], spacing: Float[Tensor, "3"], box: Float[Tensor, "2 3"]
) -> Float[Tensor, "x y z"]:
    """Compute `VoxelGrid.clearance_grid`."""
    varies = max_pool3d((table[..., 1:] != 0).any(-1)[None].float(), 2, stride=1)[0] > 0  # at any corner of a cell
    cell = spacing.double().numpy()
    # The distance between two cell centres exceeds that between any of their points by at most a cell diagonal.
    distance = distance_to_set(varies.numpy(), cell) - np.linalg.norm(cell)
    diagonal = float(torch.linalg.vector_norm(box[1] - box[0]))
    return torch.from_numpy(distance.clip(0, diagonal)).to(table)
