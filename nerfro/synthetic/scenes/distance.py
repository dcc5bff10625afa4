"""Signed distances (negative inside) of simple solids, and their triangulation.

Points are [..., 3] in world units. Some distances are bounds only (ellipsoids, unions): they have the right sign and
zero set and never change faster than 1 per unit of length, which is all that `triangulate` needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from skimage.measure import marching_cubes

from nerfro.synthetic.scene import SurfaceMesh, Vector

Distance = Callable[[np.ndarray], np.ndarray]
Colour = Callable[[np.ndarray], np.ndarray]

_BLOCK = 16  # cells per side of the blocks that are skipped where no surface passes


def ball(points: np.ndarray, centre: Vector, radius: float) -> np.ndarray:
    """Distance to a ball."""
    return np.linalg.norm(points - np.asarray(centre), axis=-1) - radius


def mirrored(points: np.ndarray) -> np.ndarray:
    """Points with |y| instead of y: a solid of them is symmetric."""
    return points * np.array([1.0, 0.0, 1.0]) + np.abs(points) * np.array([0.0, 1.0, 0.0])


def rounded(excess: np.ndarray, rounding: float) -> np.ndarray:
    """Distance to where all of `excess` [..., K], distances across each other, are negative, grown by `rounding`."""
    return np.linalg.norm(np.maximum(excess, 0.0), axis=-1) + np.minimum(excess.max(-1), 0.0) - rounding


def ellipsoid(points: np.ndarray, centre: Vector, radii: Vector) -> np.ndarray:
    """Bound on the distance to an ellipsoid with axes along x, y, z."""
    scaled = (points - np.asarray(centre)) / np.asarray(radii)
    return (np.linalg.norm(scaled, axis=-1) - 1) * min(radii)


def block(points: np.ndarray, centre: Vector, half_sides: Vector, rounding: float) -> np.ndarray:
    """Distance to a box with rounded edges; `half_sides` include the rounding."""
    return rounded(np.abs(points - np.asarray(centre)) - (np.asarray(half_sides) - rounding), rounding)


def capsule(points: np.ndarray, start: Vector, end: Vector, start_radius: float, end_radius: float) -> np.ndarray:
    """Bound on the distance to a rod with round ends whose radius changes linearly from `start` to `end`."""
    first, axis = np.asarray(start, np.float64), np.asarray(end, np.float64) - np.asarray(start, np.float64)
    offset = points - first
    along = np.clip(offset @ axis / (axis @ axis), 0.0, 1.0)
    distance = np.linalg.norm(offset - along[..., None] * axis, axis=-1)
    slope = abs(end_radius - start_radius) / np.linalg.norm(axis)
    return (distance - (start_radius + (end_radius - start_radius) * along)) / np.sqrt(1 + slope**2)


def star(points: np.ndarray, outer: float, inner: float, tips: int) -> np.ndarray:
    """Distance in the x-z plane to a star with one tip up; `outer` and `inner` are the radii of tips and notches."""
    sector = np.pi / tips
    angle = np.arctan2(points[..., 0], points[..., 2])
    folded = np.abs((angle + sector) % (2 * sector) - sector)
    radius = np.hypot(points[..., 0], points[..., 2])
    folded_point = np.stack([radius * np.cos(folded), radius * np.sin(folded)], -1)
    tip, notch = np.array([outer, 0.0]), inner * np.array([np.cos(sector), np.sin(sector)])
    edge = notch - tip
    along = np.clip((folded_point - tip) @ edge / (edge @ edge), 0.0, 1.0)
    distance = np.linalg.norm(folded_point - tip - along[..., None] * edge, axis=-1)
    # The origin is on the positive side of the directed edge from tip to notch, and so is the inside.
    inside = edge[0] * (folded_point - tip)[..., 1] - edge[1] * (folded_point - tip)[..., 0] > 0
    return np.where(inside, -distance, distance)


def smooth_union(distances: Sequence[np.ndarray], width: float) -> np.ndarray:
    """Bound on the distance to a union whose creases are filled over about `width` (polynomial smooth minimum)."""
    total = distances[0]
    for distance in distances[1:]:
        overlap = np.maximum(width - np.abs(total - distance), 0.0) / width
        total = np.minimum(total, distance) - 0.25 * width * overlap**2
    return total


def triangulate(distance: Distance, low: Vector, high: Vector, spacing: float) -> SurfaceMesh:
    """Mesh the zero set of a distance with marching cubes, then pull the vertices and normals onto the exact surface.

    Args:
        distance: signed distance, or a bound on it.
        low, high: corners of a box that contains the solid.
        spacing: cell size, world units; vertices lie within about its square of the zero set.
    """
    origin = np.asarray(low, np.float64) - 2 * spacing
    blocks = np.ceil((np.asarray(high) + 2 * spacing - origin) / (spacing * _BLOCK)).astype(int)
    values = np.empty(blocks * _BLOCK, np.float32)
    cell = np.stack(np.meshgrid(*(np.arange(_BLOCK),) * 3, indexing="ij"), -1) * spacing
    middle, reach = 0.5 * (_BLOCK - 1) * spacing, (0.5 * np.sqrt(3) * _BLOCK + 2) * spacing
    for corner in np.ndindex(*blocks):
        start = np.asarray(corner) * _BLOCK
        corner_point = origin + start * spacing
        here = tuple(slice(first, first + _BLOCK) for first in start)
        centre = float(distance((corner_point + middle)[None])[0])
        values[here] = distance(corner_point + cell) if abs(centre) < reach else centre
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    vertices = origin + vertices * spacing
    for _ in range(3):
        gradient = _gradient(distance, vertices, 0.02 * spacing)
        squared = np.maximum((gradient**2).sum(-1), 1e-2)
        # Half a cell at most: where two solids meet in a crease the gradient jumps and Newton's step goes astray.
        step = np.clip(distance(vertices) / squared, -0.5 * spacing, 0.5 * spacing)
        vertices = vertices - step[:, None] * gradient
    gradient = _gradient(distance, vertices, 0.25 * spacing)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return SurfaceMesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))


def painted(distance: Distance, colour: Colour, low: Vector, high: Vector, spacing: float) -> SurfaceMesh:
    """Mesh a solid as `triangulate` does and colour its vertices with `colour`(points [V, 3]) -> sRGB [V, 3]."""
    surface = triangulate(distance, low, high, spacing)
    colours = np.clip(colour(surface.vertices.astype(np.float64)), 0.0, 1.0)
    return replace(surface, colours=colours.astype(np.float32))


def moved(surface: SurfaceMesh, offset: Vector) -> SurfaceMesh:
    """Translate a surface by `offset` (world units)."""
    return replace(surface, vertices=(surface.vertices + np.asarray(offset)).astype(np.float32))


def _gradient(distance: Distance, points: np.ndarray, step: float) -> np.ndarray:
    """Return central differences of `distance`, [V, 3]."""
    offsets = step * np.eye(3)
    columns = [(distance(points + offset) - distance(points - offset)) / (2 * step) for offset in offsets]
    return np.stack(columns, -1)
