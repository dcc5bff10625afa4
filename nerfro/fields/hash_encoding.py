"""Multi-resolution hash encoding in plain PyTorch: reference of the compiled kernels, and the implementation for GPUs.

Source: Mueller et al., Instant Neural Graphics Primitives, 2022, section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.kernels.constants import constant

# Features per vertex. The compiled kernels assume two, which one 64-bit load fetches.
NUM_FEATURES = 2

# Corners of a cell, x fastest.
_CORNERS = tuple((i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1))

# Factors of the spatial hash (Eqn. 4). The factor of x is 1, so that neighbours in x share a cache line.
HASH_Y, HASH_Z = 2654435761, 805459861


@dataclass(frozen=True)
class GridLevels:
    """Layout of the levels in one table, from coarse to fine.

    A level is dense if (resolution + 1)^3 vertices fit into `size` entries, and hashed otherwise.
    """

    resolutions: tuple[int, ...]  # cells along the side of the unit cube
    sizes: tuple[int, ...]  # entries of each level; a power of two for hashed levels

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First entry of each level."""
        return tuple(sum(self.sizes[:level]) for level in range(len(self.sizes)))

    @cached_property
    def num_entries(self) -> int:
        return sum(self.sizes)

    @cached_property
    def dense(self) -> tuple[bool, ...]:
        return tuple((n + 1) ** 3 <= size for n, size in zip(self.resolutions, self.sizes, strict=True))

    def __len__(self) -> int:
        return len(self.resolutions)


def grid_levels(num_levels: int, base_resolution: int, finest_resolution: int, log2_table_size: int) -> GridLevels:
    """Return levels with resolutions in geometric progression (Eqns. 2 and 3); a single level is the finest."""
    growth = math.log(finest_resolution / base_resolution) / max(num_levels - 1, 1)
    base_resolution = base_resolution if num_levels > 1 else finest_resolution
    # The small addend prevents the last level from being rounded down to one cell less than requested.
    resolutions = [math.floor(base_resolution * math.exp(level * growth) + 1e-6) for level in range(num_levels)]
    sizes = [min((n + 1) ** 3, 2**log2_table_size) for n in resolutions]
    return GridLevels(tuple(resolutions), tuple(sizes))


def hash_encode(
    positions: Float[Tensor, "points 3"], table: Float[Tensor, "T 2"], levels: GridLevels
) -> Float[Tensor, "points F"]:
    """Interpolate the features of every level trilinearly and concatenate them.

    Args:
        positions: positions in the unit cube; others are clamped to the cube. Differentiable within a cell.
        table: entries of all levels. Differentiable.
        levels: layout of the table.
    """
    index, weight = _vertices(positions.to(table.dtype), levels)
    # The gradient of index_select is one index_add, whereas that of indexing with brackets sorts all indices.
    features = table.index_select(0, index.flatten()).view(*index.shape, NUM_FEATURES)
    return (features * weight[..., None]).sum(2).flatten(1)


def _vertices(
    positions: Float[Tensor, "points 3"], levels: GridLevels
) -> tuple[Int[Tensor, "points L 8"], Float[Tensor, "points L 8"]]:
    """Return table entries and interpolation weights of the eight vertices around each position, for every level."""
    resolution, size, offset = (
        constant(values, positions.device) for values in (levels.resolutions, levels.sizes, levels.offsets)
    )
    is_dense = constant(levels.dense, positions.device, torch.bool)
    corner = constant(_CORNERS, positions.device)
    scaled = positions.clamp(0, 1)[:, None] * resolution[:, None]
    cell = torch.minimum(scaled.long(), resolution[:, None] - 1)
    fraction = scaled - cell
    x, y, z = (cell[:, :, None] + corner).unbind(-1)
    stride = resolution[:, None] + 1
    dense = x + stride * (y + stride * z)
    hashed = (x ^ (y * HASH_Y) ^ (z * HASH_Z)) % size[:, None]
    index = torch.where(is_dense[:, None], dense, hashed) + offset[:, None]
    # The gradient of prod would wait for the device to count zeros.
    along_x, along_y, along_z = torch.where(corner.bool(), fraction[:, :, None], 1 - fraction[:, :, None]).unbind(-1)
    return index, along_x * along_y * along_z
