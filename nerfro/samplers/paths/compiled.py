"""The compiled tracer of bodies, as an operator of PyTorch."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from nerfro.core.types import OpticalRecord, Path, Rays
from nerfro.geometry.intersection import TriangleTree
from nerfro.kernels.lookup import Solids
from nerfro.kernels.operators import arrays, cpu_operator
from nerfro.kernels.threads import share_parts
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.polylines import SnellTrace, split
from nerfro.samplers.paths.snell_cpu import TracedRows, polylines_of_width, trace_snell

if TYPE_CHECKING:
    from nerfro.media.bodies import Bodies

# Capacity of the first attempt: vertices of a polyline, and polylines of a ray. Rays that need more are traced again;
# these have many reflections and are slow, so the capacity covers the usual numbers.
_MAX_VERTICES, _MAX_POLYLINES = 18, 8


def trace_bodies(
    rays: Rays, medium: Bodies, tree: TriangleTree | None, max_events: int, branching: Branching
) -> SnellTrace:
    """Trace rays by the compiled kernel, on the CPU for rays on any device.

    A GPU would need a million small operators of PyTorch for the rays of one training step.

    Args:
        rays: rays.
        medium: bodies with grids.
        tree: triangles of the bodies; None for the zero levels of the grids.
        max_events: largest number of refractions and reflections of a polyline.
        branching: which parts of light that is partly reflected are followed.
    """
    *solids, nested, shell = medium.packed()
    *triangles, num_layers, offset = tree or (0, 0.0)
    columns = _trace(
        rays.origins.cpu(), rays.directions.cpu(), rays.near.cpu(), rays.far.cpu(),
        [torch.from_numpy(values) for values in solids], nested, shell,
        [torch.from_numpy(values) for values in triangles], num_layers, offset, max_events, *branching,
    )  # fmt: skip
    ray, positions, directions, s, body, surface, far_side, triangle, weight, numbers = [
        column.to(rays.radii.device) for column in columns
    ]
    num_vertices, num_events, exceeded = numbers.unbind(1)
    radii = rays.radii[ray] if branching.max_split_events else rays.radii
    record = OpticalRecord.of_bodies(body, surface, far_side)
    if tree is not None:
        record = replace(record, triangle=triangle)
    path = Path.unbranched(positions, directions, s, num_vertices > 2, radii, record)
    if branching.max_split_events:
        path = split(path, ray, weight)
    return SnellTrace(path, num_events, exceeded.bool())


def _shapes(origins: Tensor, *_: Any) -> tuple[Tensor, ...]:
    size = torch.library.get_ctx().new_dynamic_size
    rows, vertices = size(), size()
    of_vertices = [origins.new_empty(rows, vertices, *axes) for axes in ((3,), (3,), ())]
    of_bodies = [origins.new_empty(rows, vertices, dtype=dtype) for dtype in (*[torch.int8] * 3, torch.int32)]
    ray, numbers = (origins.new_empty(rows, *axes, dtype=torch.int64) for axes in ((), (3,)))
    return ray, *of_vertices, *of_bodies, origins.new_empty(rows), numbers


@cpu_operator(
    "trace_snell(Tensor origins, Tensor directions, Tensor near, Tensor far, Tensor[] solids, bool nested, float shell,"
    " Tensor[] triangles, int num_layers, float offset, int max_events, int max_split_events, float least_weight, "
    "bool main_only) -> (Tensor ray, Tensor positions, Tensor exit_directions, Tensor s, Tensor body, Tensor surface, "
    "Tensor far_side, Tensor triangle, Tensor weight, Tensor numbers)",
    _shapes,
)
def _trace(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, solids: list[Tensor], nested: bool, shell: float,
    triangles: list[Tensor], num_layers: int, offset: float,
    max_events: int, max_split_events: int, least_weight: float, main_only: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Trace rays; returns ray, vertices and numbers of each polyline, see `TracedRows`.

    Args:
        origins, directions, near, far: rays.
        solids: arrays of `kernels.lookup.Solids`.
        nested, shell: numbers of `kernels.lookup.Solids`.
        triangles: arrays of `TriangleTree`; none for the zero levels of the grids.
        num_layers, offset: numbers of `TriangleTree`.
        max_events: largest number of events of a polyline.
        max_split_events, least_weight, main_only: see `Branching`.
    """
    rays = ray_arrays(origins, directions, near, far)
    of_bodies: dict[str, Any] = {name: values.numpy() for name, values in zip(Solids._fields, solids, strict=False)}
    packed = Solids(**of_bodies, nested=nested, shell=shell)
    tree = TriangleTree._make([*arrays(*triangles), num_layers, offset]) if triangles else None
    settings = max_events, max_split_events, least_weight, main_only
    max_polylines = _MAX_POLYLINES if max_split_events and not main_only else 1
    rows, counts = _traced(rays, (packed, tree), settings, _MAX_VERTICES, max_polylines)
    kept, needed = (counts <= (max_polylines, _MAX_VERTICES)).all(1), counts.max(0, initial=1)
    width = max(int(needed[1]), 2)
    columns = _polylines(rows, np.where(kept, counts[:, 0], 0), width)
    if not kept.all():
        rest = (~kept).nonzero()[0]
        few = ray_arrays(origins[rest], directions[rest], near[rest], far[rest])
        rows, counts = _traced(few, (packed, tree), settings, width, int(needed[0]))
        again = _polylines(rows, counts[:, 0], width)
        pairs = zip(columns, [rest[again[0]], *again[1:]], strict=True)
        joined = [np.concatenate(pair) for pair in pairs]
        order = np.argsort(joined[0], kind="stable")
        columns = [column[order] for column in joined]
    return (*map(torch.from_numpy, columns),)


def _traced(
    rays: tuple[np.ndarray, ...], surfaces: tuple[Solids, TriangleTree | None], settings: tuple[int, int, float, bool],
    max_vertices: int, max_polylines: int,
) -> tuple[TracedRows, Int[np.ndarray, "R 2"]]:  # fmt: skip
    """Return the polylines of rays with memory for S vertices and P polylines each, and their counts.

    Returns:
        rows: `TracedRows` of all rays, with a leading axis R, in the precision of the rays. Entries after the last
            vertex of a polyline are undefined.
        counts: number of polylines of each ray, and largest number of vertices, which may exceed P and S.
    """
    polylines, dtype = (len(rays[0]), max_polylines), rays[0].dtype
    rows = TracedRows(
        np.empty((*polylines, max_vertices, 7), dtype), np.empty((*polylines, max_vertices, 4), np.int32),
        np.empty(polylines, dtype), np.empty((*polylines, 3), np.int64),
    )  # fmt: skip
    counts = np.empty((len(rays[0]), 2), np.int64)

    def trace(part: slice) -> None:
        of_part = TracedRows(*(values[part] for values in rows))
        trace_snell(tuple(values[part] for values in rays), *surfaces, settings, of_part, counts[part])

    share_parts(trace, len(counts))
    return rows, counts


def ray_arrays(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rays as kernels take them; see `kernels.operators.arrays`."""
    origins_, directions_, near_, far_ = arrays(origins, directions, near, far)
    return origins_, directions_, near_, far_


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
    return [ray, *of_vertices, rows.weight[valid], rows.numbers[valid]]
