"""The compiled tracer of bodies with distance grids, as an operator of PyTorch."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from nerfro.core.types import OpticalRecord, Path, Rays
from nerfro.kernels.lookup import Solids
from nerfro.kernels.operators import arrays, cpu_operator
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.polylines import SnellTrace
from nerfro.samplers.paths.snell_cpu import Settings, TracedRows, polylines_of_width, trace_snell

if TYPE_CHECKING:
    from nerfro.media.bodies import Bodies

# Capacity of the first attempt: vertices of a polyline, and polylines of a ray. Rays that need more are traced again;
# these have many reflections and are slow, so the capacity covers the usual numbers.
_MAX_VERTICES, _MAX_POLYLINES = 18, 8


def snell_on_grid(rays: Rays, medium: Bodies, max_events: int, branching: Branching) -> SnellTrace:
    """Evaluate `samplers.paths.snell.trace_interfaces` by the compiled kernel, on the CPU for rays on any device.

    A GPU would need a million small operators of PyTorch for the rays of one training step.
    """
    solids, branches = medium.packed(), branching.max_split_events > 0
    columns = _trace(
        rays.origins.cpu(), rays.directions.cpu(), rays.near.cpu(), rays.far.cpu(),
        [torch.from_numpy(values) for values in solids if isinstance(values, np.ndarray)], solids.nested, solids.shell,
        max_events, branching.max_split_events, branching.least_weight, branching.main_only,
    )  # fmt: skip
    ray, positions, directions, s, body, surface, far_side, weight, num_vertices, num_events, exceeded = [
        column.to(rays.radii.device) for column in columns
    ]
    radii = rays.radii[ray] if branches else rays.radii
    record = OpticalRecord.of_bodies(body, surface, far_side)
    path = Path.unbranched(positions, directions, s, num_vertices > 2, radii, record)
    if branches:
        path = replace(path, splits=True, ray=ray, throughput=weight[:, None].expand(-1, 3))
    return SnellTrace(path, num_events, exceeded)


def _shapes(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, solids: list[Tensor], nested: bool, shell: float,
    max_events: int, max_split_events: int, least_weight: float, main_only: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    size = torch.library.get_ctx().new_dynamic_size
    rows, vertices = size(), size()
    of_bodies = [origins.new_empty(rows, vertices, dtype=torch.int8) for _ in range(3)]
    of_vertices = origins.new_empty(rows, vertices, 3), origins.new_empty(rows, vertices, 3)
    counts = [origins.new_empty(rows, dtype=torch.int64) for _ in range(3)]
    s, weight, exceeded = origins.new_empty(rows, vertices), origins.new_empty(rows), counts[0].bool()
    return counts[0], *of_vertices, s, *of_bodies, weight, counts[1], counts[2], exceeded


@cpu_operator(
    "trace_snell(Tensor origins, Tensor directions, Tensor near, Tensor far, Tensor[] solids, bool nested, float shell,"
    " int max_events, int max_split_events, float least_weight, bool main_only) -> (Tensor ray, Tensor positions, "
    "Tensor exit_directions, Tensor s, Tensor body, Tensor surface, Tensor far_side, Tensor weight, "
    "Tensor num_vertices, Tensor num_events, Tensor exceeded)",
    _shapes,
)
def _trace(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, solids: list[Tensor], nested: bool, shell: float,
    max_events: int, max_split_events: int, least_weight: float, main_only: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Trace rays; returns ray, vertices and numbers of each polyline, see `TracedRows`.

    Args:
        origins, directions, near, far: rays.
        solids: arrays of `kernels.lookup.Solids`.
        nested, shell: numbers of `kernels.lookup.Solids`.
        max_events, max_split_events, least_weight, main_only: see `snell_cpu.Settings`.
    """
    rays = arrays(origins, directions, near, far)
    names = [name for name in Solids._fields if name not in ("nested", "shell")]
    of_bodies: dict[str, Any] = {name: values.numpy() for name, values in zip(names, solids, strict=True)}
    packed = Solids(**of_bodies, nested=nested, shell=shell)
    settings = Settings(max_events, max_split_events, least_weight, main_only)
    max_polylines = _MAX_POLYLINES if max_split_events and not main_only else 1
    rows, counts = trace_snell(rays[0], rays[1], rays[2], rays[3], packed, settings, _MAX_VERTICES, max_polylines)
    kept, needed = (counts <= (max_polylines, _MAX_VERTICES)).all(1), counts.max(0, initial=1)
    width = max(int(needed[1]), 2)
    columns = _polylines(rows, np.where(kept, counts[:, 0], 0), width)
    if not kept.all():
        rest = (~kept).nonzero()[0]
        few = [values[rest] for values in rays]
        rows, counts = trace_snell(few[0], few[1], few[2], few[3], packed, settings, width, int(needed[0]))
        again = _polylines(rows, counts[:, 0], width)
        pairs = zip(columns, [rest[again[0]], *again[1:]], strict=True)
        joined = [np.concatenate(pair) for pair in pairs]
        order = np.argsort(joined[0], kind="stable")
        columns = [column[order] for column in joined]
    return (*map(torch.from_numpy, columns),)


def _polylines(rows: TracedRows, counts: Int[np.ndarray, "R"], width: int) -> list[np.ndarray]:
    """Select polylines; returns their rays, arrays with a column per vertex, and values per polyline.

    Args:
        rows: results of the kernel.
        counts: number of polylines to select of each ray, at most the capacity.
        width: number of vertices.
    """
    valid = np.arange(rows.weight.shape[1]) < counts[:, None]
    ray, branch = map(np.ascontiguousarray, valid.nonzero())
    of_vertices = polylines_of_width(rows, ray, branch, width)
    weight, num_vertices, num_events = rows.weight[valid], rows.num_vertices[valid], rows.num_events[valid]
    return [ray, *of_vertices, weight, num_vertices, num_events, rows.exceeded[valid]]


def ray_arrays(rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    origins, directions, near, far = arrays(rays.origins, rays.directions, rays.near, rays.far)
    return origins, directions, near, far
