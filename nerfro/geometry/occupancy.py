"""Fraction of each grid cell that lies inside a mesh, by ray parity along columns of the grid."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int
from numba import prange

from nerfro.core.progress import track
from nerfro.geometry.mesh import TriangleMesh
from nerfro.kernels.compilation import compiled, compiled_parallel

PLANES = 16  # planes of a grid per update of the progress bar


def occupancy_fraction(
    mesh: TriangleMesh, box: Float[np.ndarray, "2 3"], resolution: int, subsamples: int = 4
) -> Float[np.ndarray, "X Y Z"]:
    """Compute the fraction A / (A + B) of sub-samples inside a mesh, for the sub-samples around every grid vertex.

    The subsamples^3 points around a vertex are spaced evenly from -h to h on each axis with the spacing h, as in the
    authors' code. A point is inside if a line from the point crosses the mesh an odd number of times. One line serves
    a column of points, so the computation costs as much as rasterizing the mesh.

    Args:
        mesh: world units. If the mesh is not closed, the majority of lines along x, y and z decides.
        box: lower and upper corner of the grid, world units.
        resolution: number of vertices per side, with vertices on both ends of the box.
        subsamples: number of sub-samples per axis.
    """
    offsets = np.linspace(-1.0, 1.0, subsamples) if subsamples > 1 else np.zeros(1)
    votes = []
    for axes in ([0, 1, 2],) if mesh.is_closed else ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        triangles = np.ascontiguousarray(mesh.triangles[..., axes])
        origin, end = np.asarray(box, np.float64)[:, axes]
        spacing = (end - origin) / (resolution - 1)
        order, starts = triangles_by_plane(triangles, origin[0], spacing[0], resolution, float(spacing[0]))
        counts = np.zeros((resolution,) * 3, np.uint16)
        for first in track("occupancy", range(0, resolution, PLANES)):
            planes = counts[first : first + PLANES]
            _count_inside(triangles, order, starts[first:], origin, spacing, offsets, first, planes)
        votes.append((counts.astype(np.float32) / subsamples**3).transpose(np.argsort(axes)))
    return votes[0] if len(votes) == 1 else np.median(votes, axis=0).astype(np.float32)


def triangles_by_plane(
    triangles: Float[np.ndarray, "F 3 3"], origin: float, spacing: float, num_planes: int, reach: float
) -> tuple[Int[np.ndarray, " entries"], Int[np.ndarray, " starts"]]:
    """Return triangles within `reach` of the planes x = origin + i spacing, sorted by plane, with plane starts."""
    low = np.ceil((triangles[:, :, 0].min(1) - reach - origin) / spacing).astype(np.int64).clip(0, num_planes)
    high = np.floor((triangles[:, :, 0].max(1) + reach - origin) / spacing).astype(np.int64).clip(-1, num_planes - 1)
    uses = (high - low + 1).clip(0)
    triangle = np.repeat(np.arange(len(triangles)), uses)
    plane = np.repeat(low - np.cumsum(uses) + uses, uses) + np.arange(uses.sum())
    starts = np.concatenate([[0], np.cumsum(np.bincount(plane, minlength=num_planes))])
    return triangle[np.argsort(plane, kind="stable")], starts


@compiled
def _edge_side(ax: float, ay: float, bx: float, by: float, px: float, py: float) -> float:
    """Return twice the signed area of (a, b, p); swapping a and b changes only the sign of the result."""
    if ax < bx or (ax == bx and ay < by):
        return (bx - ax) * (py - ay) - (by - ay) * (px - ax)
    return -((ax - bx) * (py - by) - (ay - by) * (px - bx))


@compiled
def _is_left(side: float, ax: float, ay: float, bx: float, by: float) -> bool:
    """Return the sign of `_edge_side`; points on a line are moved by (e, e^2), so that one triangle of two is hit."""
    if side != 0.0:
        return side > 0.0
    if ay != by:
        return by < ay
    return bx > ax


@compiled_parallel
def _count_inside(triangles, order, starts, origin, spacing, offsets, first_plane, counts):
    """Count the sub-samples inside the mesh for the planes of the grid from number `first_plane` on."""
    num, resolution = len(offsets), counts.shape[1]
    for i in prange(len(counts)):
        crossings = np.zeros((resolution, num, num, resolution + 1), np.uint8)
        for a in range(num):
            crossings[:] = 0
            x = origin[0] + (first_plane + i + offsets[a]) * spacing[0]
            for index in order[starts[i] : starts[i + 1]]:
                t = triangles[index]
                if x < min(t[0, 0], t[1, 0], t[2, 0]) or x > max(t[0, 0], t[1, 0], t[2, 0]):
                    continue
                y_low, y_high = min(t[0, 1], t[1, 1], t[2, 1]), max(t[0, 1], t[1, 1], t[2, 1])
                z_low, z_high = min(t[0, 2], t[1, 2], t[2, 2]), max(t[0, 2], t[1, 2], t[2, 2])
                first = max(math.floor((y_low - origin[1]) / spacing[1]) - 1, 0)
                last = min(math.ceil((y_high - origin[1]) / spacing[1]) + 1, resolution - 1)
                for j in range(first, last + 1):
                    for b in range(num):
                        y = origin[1] + (j + offsets[b]) * spacing[1]
                        if y < y_low or y > y_high:
                            continue
                        side_0 = _edge_side(t[1, 0], t[1, 1], t[2, 0], t[2, 1], x, y)
                        side_1 = _edge_side(t[2, 0], t[2, 1], t[0, 0], t[0, 1], x, y)
                        side_2 = _edge_side(t[0, 0], t[0, 1], t[1, 0], t[1, 1], x, y)
                        left = _is_left(side_0, t[1, 0], t[1, 1], t[2, 0], t[2, 1])
                        if left != _is_left(side_1, t[2, 0], t[2, 1], t[0, 0], t[0, 1]):
                            continue
                        if left != _is_left(side_2, t[0, 0], t[0, 1], t[1, 0], t[1, 1]):
                            continue
                        area = side_0 + side_1 + side_2
                        z = z_low
                        if area != 0.0:
                            z = (side_0 * t[0, 2] + side_1 * t[1, 2] + side_2 * t[2, 2]) / area
                            z = min(max(z, z_low), z_high)
                        for c in range(num):
                            k = math.ceil((z - origin[2]) / spacing[2] - offsets[c])
                            crossings[j, b, c, min(max(k, 0), resolution)] ^= 1
            for j in range(resolution):
                for b in range(num):
                    for c in range(num):
                        inside = np.uint8(0)
                        for k in range(resolution):
                            inside ^= crossings[j, b, c, k]
                            counts[i, j, k] += inside
