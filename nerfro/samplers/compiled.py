"""From rays and media to the compiled kernels' arrays, and back to paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.kernels.arrays import arrays
from nerfro.types import Path, Rays

if TYPE_CHECKING:
    from nerfro.kernels.lookup import MediumGrid
    from nerfro.media.sdf_grid import SdfGrid
    from nerfro.media.voxel_grid import VoxelGrid

# Vertices that a first attempt has room for; the few rays that need more are traced again. Those of many reflections
# are slow, so there is room for all that is usual.
_CAPACITY = 18


def snell_on_grid(
    rays: Rays, medium: SdfGrid, min_step: float, max_events: int
) -> tuple[Path, Int[Tensor, "R"], Bool[Tensor, "R"]]:
    """`samplers.snell.trace_interfaces` by the compiled kernel."""
    from nerfro.samplers.snell_cpu import trace_snell

    solids = _for_kernels(medium)
    settings = (solids, min_step * float((solids.high - solids.low).min()), max_events)
    (*vertices, body), (events, exceeded) = _with_enough_vertices(rays, trace_snell, settings, 4)
    num_events = torch.from_numpy(events)
    return _path(rays, vertices, num_events > 0, body), num_events, torch.from_numpy(exceeded)


def eikonal_on_grid(
    rays: Rays, medium: VoxelGrid | SdfGrid, step: float, tolerance: float, max_steps: int
) -> tuple[Path, Bool[Tensor, "R"]]:
    """`samplers.eikonal.march_adaptive` by the compiled kernel."""
    from nerfro.samplers.eikonal_cpu import march_adaptive

    settings = (_for_kernels(medium), step, tolerance, max_steps)
    vertices, (refracted, exceeded) = _with_enough_vertices(rays, march_adaptive, settings, 3)
    return _path(rays, vertices, torch.from_numpy(refracted)), torch.from_numpy(exceeded)


def uniform_on_grid(rays: Rays, medium: VoxelGrid, integrator: str, num_steps: int) -> Path:
    """`samplers.eikonal.march_uniform` by the compiled kernel."""
    *vertices, refracted = _march_uniform(rays, medium, integrator, num_steps, keep_all=True)
    return _path(rays, vertices, torch.from_numpy(refracted))


def uniform_exit_on_grid(rays: Rays, medium: VoxelGrid, integrator: str, num_steps: int) -> Float[Tensor, "R 3"]:
    """Exit directions alone of `uniform_on_grid`, without the memory of all vertices."""
    return torch.from_numpy(_march_uniform(rays, medium, integrator, num_steps, keep_all=False)[1][:, 0])


def _march_uniform(
    rays: Rays, medium: VoxelGrid, integrator: str, num_steps: int, keep_all: bool
) -> tuple[np.ndarray, ...]:
    from nerfro.samplers import eikonal_cpu as eikonal

    code = {"euler": eikonal.EULER, "leapfrog": eikonal.LEAPFROG, "rk4": eikonal.RK4}[integrator]
    origins, directions, near, far = _ray_arrays(rays)
    return eikonal.march_uniform(origins, directions, near, far, _for_kernels(medium), code, num_steps, keep_all)


def _with_enough_vertices(
    rays: Rays, kernel: Callable, settings: tuple, num_arrays: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Run a kernel, and run it again for the rays whose vertices did not fit.

    Returns:
        The first `num_arrays` results, which have a column for each vertex, and those that follow the counts.
    """
    of_rays = _ray_arrays(rays)
    capacity = _CAPACITY
    results = kernel(*of_rays, *settings, capacity)
    columns, counts, rest = list(results[:num_arrays]), results[num_arrays], list(results[num_arrays + 1 :])
    width = max(int(counts.max(initial=2)), 2)
    if width > capacity:
        rows = np.nonzero(counts > capacity)[0]
        again = kernel(*(array[rows] for array in of_rays), *settings, width)[:num_arrays]
        for i, (short, long) in enumerate(zip(columns, again, strict=True)):
            columns[i] = np.concatenate([short, np.repeat(short[:, -1:], width - capacity, axis=1)], axis=1)
            columns[i][rows] = long
    return [column[:, :width] for column in columns], rest


def _ray_arrays(rays: Rays) -> list[np.ndarray]:
    return arrays(rays.origins, rays.directions, rays.near, rays.far)


def _for_kernels(medium: VoxelGrid | SdfGrid) -> MediumGrid:
    from nerfro.kernels.lookup import MediumGrid
    from nerfro.media.sdf_grid import BLOCK, SdfGrid

    low, high = medium.box.double().numpy()
    if isinstance(medium, SdfGrid):
        inverse_spacing = (np.array(medium.coefficients.shape[1:]) - 1) / (high - low)
        values, clearance = medium.coefficients.detach().numpy(), medium.coarse_clearance.numpy()
        return MediumGrid(
            values,
            clearance,
            medium.iors.detach().double().numpy(),
            medium.shell,
            low,
            high,
            inverse_spacing,
            inverse_spacing / BLOCK,
        )
    inverse_spacing = (np.array(medium.table.shape[:3]) - 1) / (high - low)
    values, clearance = medium.table.detach().numpy(), medium.clearance_grid.numpy()
    return MediumGrid(values, clearance, None, 0.0, low, high, inverse_spacing, inverse_spacing)


def _path(rays: Rays, vertices: Sequence[np.ndarray], refracted: Tensor, body: np.ndarray | None = None) -> Path:
    arrays = [*vertices] if body is None else [*vertices, body]
    positions, directions, s, *bodies = (torch.from_numpy(np.ascontiguousarray(array)) for array in arrays)
    return Path(positions, directions, s, directions[:, -1], refracted, rays.radii, body=bodies[0] if bodies else None)  # type: ignore[arg-type]
