"""Conversion of rays and media to the arrays of the compiled kernels, and of their results to paths."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Int

from nerfro.core.types import Path, Rays
from nerfro.kernels.arrays import input_arrays
from nerfro.samplers.paths.branching import Branching
from nerfro.samplers.paths.polylines import SnellTrace

if TYPE_CHECKING:
    from nerfro.media.bodies import Bodies
    from nerfro.samplers.paths.snell_cpu import TracedRows

# Capacity of the first attempt: vertices of a polyline, and polylines of a ray. Rays that need more are traced again;
# these have many reflections and are slow, so the capacity covers the usual numbers.
_MAX_VERTICES, _MAX_POLYLINES = 18, 8


def snell_on_grid(rays: Rays, medium: Bodies, max_events: int, branching: Branching) -> SnellTrace:
    """Evaluate `samplers.paths.snell.trace_interfaces` by the compiled kernel, on the CPU for rays on any device.

    A GPU would need a million small operators of PyTorch for the rays of one training step.
    """
    from nerfro.samplers.paths.snell_cpu import Settings, trace_snell

    solids = medium.packed()
    settings = Settings(max_events, branching.max_split_events, branching.least_weight, branching.main_only)
    max_polylines = _MAX_POLYLINES if branching.max_split_events and not branching.main_only else 1
    rows, counts = trace_snell(*ray_arrays(rays), solids, settings, _MAX_VERTICES, max_polylines)
    kept, needed = (counts <= (max_polylines, _MAX_VERTICES)).all(1), counts.max(0, initial=1)
    width = max(int(needed[1]), 2)
    parts = [_polylines(rows, np.where(kept, counts[:, 0], 0), width)]
    if not kept.all():
        rest = (~kept).nonzero()[0]
        rows, counts = trace_snell(*ray_arrays(rays[torch.from_numpy(rest)]), solids, settings, width, int(needed[0]))
        again = _polylines(rows, counts[:, 0], width)
        parts.append((rest[again[0]], *again[1:]))
        order = np.argsort(np.concatenate([part[0] for part in parts]), kind="stable")
        parts = [tuple(np.concatenate(column)[order] for column in zip(*parts, strict=True))]
    owner, *columns = (torch.from_numpy(column).to(rays.radii.device) for column in parts[0])
    positions, directions, s, body, surface, across, weight, num_vertices, num_events, exceeded = columns
    radii = rays.radii[owner] if branching.max_split_events else rays.radii
    path = Path.unbranched(positions, directions, s, num_vertices > 2, radii)
    path = replace(path, body=body, surface_body=surface, across=across)
    if branching.max_split_events:
        path = replace(path, splits=True, ray=owner, throughput=weight[:, None].expand(-1, 3))
    return SnellTrace(path, num_events, exceeded)


def _polylines(rows: TracedRows, counts: Int[np.ndarray, "R"], width: int) -> tuple[np.ndarray, ...]:
    """Select polylines; returns their rays, arrays with a column per vertex, and values per polyline.

    Args:
        rows: results of the kernel.
        counts: number of polylines to select of each ray, at most the capacity.
        width: number of vertices.
    """
    from nerfro.samplers.paths.snell_cpu import polylines_of_width

    valid = np.arange(rows.weight.shape[1]) < counts[:, None]
    ray, place = (np.ascontiguousarray(indices) for indices in valid.nonzero())
    of_vertices = polylines_of_width(rows, ray, place, width)
    of_rows = rows.weight, rows.num_vertices, rows.num_events, rows.exceeded
    return ray, *of_vertices, *(column[valid] for column in of_rows)


def ray_arrays(rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    origins, directions, near, far = input_arrays(rays.origins, rays.directions, rays.near, rays.far)
    return origins, directions, near, far
