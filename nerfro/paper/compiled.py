"""Conversion of rays and media to the arrays of the compiled kernels, and of their results to paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from nerfro.core.types import Path, Rays
from nerfro.media.bodies import Bodies
from nerfro.paper.voxel_grid import VoxelGrid
from nerfro.samplers.paths.compiled import ray_arrays

if TYPE_CHECKING:
    from nerfro.paper.index_cpu import Voxels

# Capacity of the first attempt, in vertices; rays that need more are traced again.
_CAPACITY = 18


def eikonal_on_grid(rays: Rays, medium: VoxelGrid | Bodies, step: float, tolerance: float, max_steps: int) -> Path:
    """Evaluate `eikonal.march_adaptive` by the compiled kernel, on the CPU for rays on any device."""
    from nerfro.paper.eikonal_cpu import march_adaptive
    from nerfro.paper.index_cpu import NO_SOLIDS, NO_VOXELS

    bodies = medium.bodies
    packed = (_voxels(cast(VoxelGrid, medium)), NO_SOLIDS) if bodies is None else (NO_VOXELS, bodies.packed())
    settings = step, tolerance, max_steps
    *columns, counts, refracted = march_adaptive(*_arrays(rays), *packed, settings, _CAPACITY)
    width = max(int(counts.max(initial=2)), 2)
    if width > _CAPACITY:  # trace the rays with more vertices again
        rows = np.nonzero(counts > _CAPACITY)[0]
        again = march_adaptive(*_arrays(rays[torch.from_numpy(rows)]), *packed, settings, width)[:3]
        for i, (short, long) in enumerate(zip(columns, again, strict=True)):
            columns[i] = np.concatenate([short, np.repeat(short[:, -1:], width - _CAPACITY, axis=1)], axis=1)
            columns[i][rows] = long
    return _path(rays, [column[:, :width] for column in columns], refracted)


def uniform_on_grid(rays: Rays, medium: VoxelGrid, num_steps: int) -> Path:
    """Evaluate `eikonal.march_uniform` with Euler steps by the compiled kernel, on the CPU for rays on any device."""
    from nerfro.paper.eikonal_cpu import march_uniform

    *vertices, refracted = march_uniform(*_arrays(rays), _voxels(medium), num_steps)
    return _path(rays, vertices, refracted)


def _arrays(rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return ray_arrays(rays.origins, rays.directions, rays.near, rays.far)


def _voxels(medium: VoxelGrid) -> Voxels:
    from nerfro.paper.index_cpu import Voxels

    low, high = medium.box.double().cpu().numpy()
    inverse_spacing = (np.array(medium.table.shape[:3]) - 1) / (high - low)
    table, clearance = medium.host_arrays
    return Voxels(table, clearance, low, high, inverse_spacing)


def _path(rays: Rays, vertices: Sequence[np.ndarray], refracted: np.ndarray) -> Path:
    device = rays.radii.device
    positions, directions, s = (torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in vertices)
    return Path.unbranched(positions, directions, s, torch.from_numpy(refracted).to(device), rays.radii)
