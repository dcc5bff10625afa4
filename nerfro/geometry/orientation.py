"""Orientation of triangles relative to the inside of a mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

# A point of a triangle (barycentric coordinates) and a deviation from its normal, without symmetry, so that lines do
# not pass through edges of regular meshes.
_BARYCENTRIC, _DEVIATION = np.array([0.23, 0.31, 0.46]), np.array([0.07, 0.11, -0.05])


def inward_faces(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "F"]:
    """Find the triangles with the front towards the inside, where the parity along lines defines the inside.

    The outer surface of a body should face outwards and the surface of a cavity should face the cavity. Triangles that
    share an edge of two triangles form a patch with one orientation. On lines through a patch, an even number of
    crossings in front of the patch means that the front of the patch is outside. Lines with an odd number of crossings
    in total, for example through holes, have no vote. Five triangles of each patch vote, spread over its area, because
    the largest may lie inside another part of a surface that crosses itself.

    Args:
        vertices: world units; equal positions must be merged.
        faces: vertex indices of each triangle.
    """
    patch, inwards = patches(faces)
    triangles = vertices[faces]
    crosses = area_vectors(triangles)
    crosses[inwards] *= -1
    areas = np.linalg.norm(crosses, axis=1)
    order = np.lexsort((-areas, patch))
    groups = np.split(order, np.flatnonzero(np.diff(patch[order])) + 1)
    low, high = (np.stack([end(triangles[group], axis=(0, 1)) for group in groups]) for end in (np.min, np.max))
    centres, radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
    for group in groups:
        votes = 0
        upto = np.cumsum(areas[group])
        some = group[np.searchsorted(upto, np.linspace(0.1, 0.9, 5) * upto[-1])]
        for face in some[areas[some] > 0]:
            line = crosses[face] / areas[face] + _DEVIATION
            point = _BARYCENTRIC @ triangles[face]
            distances = np.linalg.norm(np.cross(centres - point, line), axis=1) / np.linalg.norm(line)
            near = np.concatenate([groups[index] for index in np.flatnonzero(distances <= radii)])
            front, behind = _count_crossings(triangles[near[near != face]] - point, line)
            votes += 0 if (front + behind) % 2 == 0 else 1 - 2 * (front % 2)
        inwards[group] ^= votes < 0
    return inwards


def area_vectors(triangles: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F 3"]:
    """Return normals by the right-hand rule, with a length of twice the area of the triangle."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def patches(faces: Int[np.ndarray, "F 3"]) -> tuple[Int[np.ndarray, "F"], Bool[np.ndarray, "F"]]:
    """Return the patch of each triangle, and the triangles to reverse for one orientation per patch.

    Triangles of a patch are connected by edges that belong to exactly two triangles.
    """
    from trimesh.graph import connected_component_labels

    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    first = np.flatnonzero(np.diff(edge[order], prepend=-1))
    first = first[np.diff(first, append=len(edge)) == 2]
    a, b = order[first], order[first + 1]
    # Each triangle is two nodes of a graph, one for each orientation; edges connect the orientations that agree.
    num = len(faces)
    other = b // 3 + np.where(start[a] == start[b], num, 0)
    links = np.concatenate([[a // 3, other], [a // 3 + num, (other + num) % (2 * num)]], axis=1)
    label = connected_component_labels(links.T, 2 * num)
    return np.minimum(label[:num], label[num:]), label[:num] > label[num:]


def _count_crossings(triangles: Float[np.ndarray, "F 3 3"], line: Float[np.ndarray, "3"]) -> tuple[int, int]:
    """Count the crossings of triangles with a line through the origin, ahead of the origin and behind the origin."""
    across = np.linalg.svd(line[None])[2][1:]
    x, y = (triangles @ axis for axis in across)
    parts = np.roll(x, -1, 1) * np.roll(y, -2, 1) - np.roll(y, -1, 1) * np.roll(x, -2, 1)
    met = (parts > 0).all(1) | (parts < 0).all(1)
    ahead = (parts[met] * (triangles[met] @ line)).sum(1) / parts[met].sum(1) > 0
    return int(ahead.sum()), int((~ahead).sum())
