"""From rays and media to the compiled kernels' arrays, and back to paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerfro.kernels.arrays import arrays
from nerfro.samplers.branching import Branching
from nerfro.types import Path, Rays

if TYPE_CHECKING:
    from nerfro.kernels.lookup import MediumGrid
    from nerfro.media.sdf_grid import SdfGrid
    from nerfro.media.voxel_grid import VoxelGrid

# Vertices that a first attempt has room for; the few rays that need more are traced again. Those of many reflections
# are slow, so there is room for all that is usual.
_CAPACITY = 18
# Polylines of a ray that a first attempt has room for.
_ROOM = 8


def snell_on_grid(
    rays: Rays, medium: SdfGrid, min_step: float, max_events: int, branching: Branching
) -> tuple[Path, Int[Tensor, "P"], Bool[Tensor, "P"]]:
    """`samplers.snell.trace_interfaces` by the compiled kernel."""
    from nerfro.samplers.snell_cpu import trace_snell

    solids = _for_kernels(medium)
    shortest = float((solids.high - solids.low).min())
    settings = (
        solids, min_step * shortest, max_events, branching.num_events, branching.least_weight, branching.main_only
    )  # fmt: skip
    of_rays, room = _ray_arrays(rays), _ROOM if branching.num_events and not branching.main_only else 1
    arguments: list[Any] = [*of_rays, *settings, _CAPACITY, room]
    *columns, counts = trace_snell(*arguments)
    kept, needed = (counts <= (room, _CAPACITY)).all(1), counts.max(0, initial=1)
    width = max(int(needed[1]), 2)
    parts = [_rows(columns, np.where(kept, counts[:, 0], 0), width)]
    if not kept.all():
        rest = (~kept).nonzero()[0]
        arguments = [*(array[rest] for array in of_rays), *settings, width, int(needed[0])]
        *columns, counts = trace_snell(*arguments)
        ray, columns = _rows(columns, counts[:, 0], width)
        parts.append((rest[ray], columns))
    ray = np.concatenate([ray for ray, _ in parts])
    order = slice(None) if len(parts) == 1 else np.argsort(ray, kind="stable")
    together = zip(*(columns for _, columns in parts), strict=True)
    columns = [each[0] if len(each) == 1 else np.concatenate(each)[order] for each in together]
    *vertices, body, weight, events, exceeded = columns
    num_events = torch.from_numpy(events)
    split = (torch.from_numpy(ray[order]), torch.from_numpy(weight)) if branching.num_events else (None, None)
    return _path(rays, vertices, num_events > 0, body, *split), num_events, torch.from_numpy(exceeded)


def _rows(
    columns: Sequence[np.ndarray], counts: Int[np.ndarray, "R"], width: int
) -> tuple[Int[np.ndarray, "P"], list[np.ndarray]]:
    """The ray of each polyline that is there, and the arrays of these polylines, with `width` vertices.

    Args:
        columns: what `trace_snell` returns but for the counts.
        counts: polylines of each ray that are wanted, as many as there is room for at most.
        width: number of vertices.
    """
    from nerfro.samplers.snell_cpu import polylines_of_width

    positions, directions, s, bodies, weights, events, exceeded = columns
    valid = np.arange(weights.shape[1]) < counts[:, None]
    ray, place = valid.nonzero()
    chosen = polylines_of_width(positions, directions, s, bodies, events, ray, place, width)
    return ray, [*chosen, weights[valid], events[valid], exceeded[valid]]


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
    from nerfro.media.sdf_grid import BLOCK, SURFACE_BLOCK, SdfGrid

    low, high = medium.box.double().numpy()
    if isinstance(medium, SdfGrid):
        inverse_spacing = (np.array(medium.coefficients.shape[1:]) - 1) / (high - low)
        values, clearance = medium.coefficients.detach().numpy(), medium.coarse_clearance.numpy()
        return MediumGrid(
            values,
            clearance,
            medium.iors.detach().double().numpy(),
            medium.nested,
            medium.shell,
            low,
            high,
            inverse_spacing,
            inverse_spacing / BLOCK,
            medium.coarse_slopes.numpy(),
            medium.empty_blocks.numpy(),
            inverse_spacing / SURFACE_BLOCK,
        )
    inverse_spacing = (np.array(medium.table.shape[:3]) - 1) / (high - low)
    values, clearance = medium.table.detach().numpy(), medium.clearance_grid.numpy()
    no_bodies = (None, None, None)
    return MediumGrid(values, clearance, None, False, 0.0, low, high, inverse_spacing, inverse_spacing, *no_bodies)


def _path(
    rays: Rays,
    vertices: Sequence[np.ndarray],
    refracted: Tensor,
    body: np.ndarray | None = None,
    ray: Tensor | None = None,
    weight: Tensor | None = None,
) -> Path:
    arrays = [*vertices] if body is None else [*vertices, body]
    positions, directions, s, *bodies = (torch.from_numpy(np.ascontiguousarray(array)) for array in arrays)
    radii = rays.radii if ray is None else rays.radii[ray]
    throughput = None if weight is None else weight[:, None].expand(-1, 3)
    return Path(
        positions, directions, s, directions[:, -1], refracted, radii,
        ray, throughput, bodies[0] if bodies else None,  # type: ignore[arg-type]
    )  # fmt: skip
