"""Surfaces of bodies: balls, boxes, bodies of revolution, distances in files, and offsets of other surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.files.reading import load_arrays
from nerfro.geometry.mesh import TriangleMesh, merge_vertices
from nerfro.geometry.normals import axes_along
from nerfro.media.distance_grid import DistanceGrid
from nerfro.media.surface import Grid, MeshSurface, Surface, direction, make_surface, vector
from nerfro.registry.allowed import Coordinate, NotNegative, Positive
from nerfro.registry.registration import register


def revolve(
    profile: Float[np.ndarray, "points 2"], foot: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> TriangleMesh:
    """Return the closed mesh of a body of revolution.

    Args:
        profile: radii and heights along the outline, which runs counter-clockwise from axis to axis or is closed.
        foot: world coordinates of height 0 on the axis.
        axis: unit direction of the axis.
    """
    import trimesh  # takes half a second

    size = np.ptp(profile, axis=0).max()  # trimesh drops triangles with areas below 1e-8
    body = trimesh.creation.revolve(profile / size, sections=160)
    return TriangleMesh(size * body.vertices @ axes_along(axis) + foot, np.asarray(body.faces))


@register("surface", "ball")
class BallSurface(Surface):
    """A ball.

    Args:
        radius: world units.
        centre: world coordinates.
    """

    def __init__(self, radius: Positive, centre: Sequence[Coordinate] = (0.0, 0.0, 0.0)) -> None:
        self._radius, self._centre = radius, vector("centre", centre)
        self.bounds = np.stack([self._centre - radius, self._centre + radius])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.linalg.norm(grid.points - self._centre, axis=-1) - self._radius


@register("surface", "box")
class BoxSurface(Surface):
    """A box with sides along the axes of the world; with one short side, a pane. Sharp edges have triangles.

    Args:
        sides: lengths along x, y and z, world units.
        centre: world coordinates.
        rounding: radius of the edges, world units.
    """

    def __init__(
        self, sides: Sequence[Positive], centre: Sequence[Coordinate] = (0.0, 0.0, 0.0), rounding: NotNegative = 0.0
    ) -> None:
        self._half, self._centre, self._rounding = 0.5 * vector("sides", sides), vector("centre", centre), rounding
        if rounding > self._half.min():
            raise NerfroError(f"surface.rounding={rounding} is not allowed; give at most half of the shortest side")
        self.bounds = np.stack([self._centre - self._half, self._centre + self._half])
        if not rounding:
            import trimesh  # takes half a second

            box = trimesh.creation.box(bounds=self.bounds)
            self.mesh = TriangleMesh(np.array(box.vertices), np.array(box.faces), facets=np.arange(len(box.faces)))

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        excess = np.abs(grid.points - self._centre) - self._half + self._rounding
        return np.linalg.norm(excess.clip(min=0), axis=-1) + excess.max(-1).clip(max=0) - self._rounding


@register("surface", "revolution")
class RevolutionSurface(MeshSurface):
    """A body of revolution with a given profile, such as a cylinder, a lens or a bottle.

    Edges of the profile are smooth up to 30 degrees, so few points describe a curve.

    Args:
        profile: [radius, height] of points along the outline, from one end of the axis to the other, world units. Ends
            away from the axis get flat faces. If the last point is the first one, the outline is a ring. The outline
            must enclose a volume, and must not meet itself.
        centre: world coordinates of height 0 on the axis.
        axis: direction of the axis; its length does not matter.
    """

    def __init__(
        self,
        profile: list[Any],
        centre: Sequence[Coordinate] = (0.0, 0.0, 0.0),
        axis: Sequence[Coordinate] = (0.0, 0.0, 1.0),
    ) -> None:
        try:
            points = np.array(profile, np.float64).reshape(len(profile), 2)
        except (ValueError, TypeError):
            points = np.empty((0, 2))
        if len(points) < 2 or not np.isfinite(points).all() or points[:, 0].min() < 0:
            raise NerfroError(
                f"surface.profile={profile} is not allowed; give points [radius, height], from end to end"
            )
        is_ring = bool((points[0] == points[-1]).all())
        if not is_ring:
            points = np.concatenate([points[:1] * [0, 1], points, points[-1:] * [0, 1]])
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(1))]
        inner, outer = points[:-1, 0], points[1:, 0]
        volume = (np.diff(points[:, 1]) * (inner**2 + inner * outer + outer**2)).sum()  # with a sign, times 3 / pi
        if volume == 0 or meets_itself(points, is_ring):
            raise NerfroError(
                f"surface.profile={profile} encloses no volume, or meets itself; give an outline that begins and ends "
                "on the axis, or a ring whose last point is the first one"
            )
        if volume < 0:
            points = points[::-1]
        mesh = revolve(points, vector("centre", centre), direction("surface.axis", axis))
        self._set(merge_vertices(mesh.vertices, mesh.faces))


def meets_itself(points: Float[np.ndarray, "points 2"], is_ring: bool) -> bool:
    """Test whether two segments of an outline that are not neighbours meet."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Return on which side of the line from p to q the point r is: -1, 0 or 1."""
        (a, b), (c, d) = (q - p).T, (r - p).T
        return np.sign(a * d - b * c)

    first, second = np.triu_indices(len(points) - 1, 2)
    if is_ring:
        is_end = (first == 0) & (second == len(points) - 2)
        first, second = first[~is_end], second[~is_end]
    starts, ends = points[:-1], points[1:]
    p, q, r, s = starts[first], ends[first], starts[second], ends[second]
    near = (np.minimum(p, q) <= np.maximum(r, s)) & (np.minimum(r, s) <= np.maximum(p, q))
    crossing = (side(p, q, r) * side(p, q, s) <= 0) & (side(r, s, p) * side(r, s, q) <= 0)
    return bool((near.all(1) & crossing).any())


@register("surface", "offset")
class OffsetSurface(Surface):
    """The points at a distance from another surface, such as the inside of a wall of constant thickness.

    Args:
        surface: name and settings of the other surface.
        distance: outwards, world units; negative for inwards.
    """

    def __init__(self, surface: dict[str, Any], distance: Coordinate) -> None:
        self._other, self._distance = make_surface(surface), distance
        self.bounds = self._other.bounds + np.array([[-1], [1]]) * max(distance, 0)
        self.known = self._other.known
        if self.known is not None and ((self.bounds[0] < self.known[0]) | (self.bounds[1] > self.known[1])).any():
            raise NerfroError(
                f"surface.distance={distance} leads out of the grid of the other surface; write a larger grid, or take "
                "a smaller distance"
            )

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return self._other.distances(grid.widened(abs(self._distance))) - self._distance


@register("surface", "grid")
class GridSurface(Surface):
    """Zero level of signed distances in a file, interpolated by quadratic B-splines.

    Args:
        file: NumPy archive (.npz) with `distances` [X, Y, Z] at the vertices of a grid, negative inside and positive at
            the border, and the lower and upper corner of the grid, `box` [2, 3]; world units.
    """

    def __init__(self, file: str) -> None:
        arrays = load_arrays(resolve_path(file))
        distances, box = (np.asarray(arrays.get(name), np.float64) for name in ("distances", "box"))
        if distances.ndim != 3 or min(distances.shape) < 3 or box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise NerfroError(f"{file} is no grid of distances; write the arrays distances [X, Y, Z] and box [2, 3]")
        inside = np.argwhere(distances < 0)
        last = np.array(distances.shape) - 1
        if not len(inside) or not np.isfinite(distances).all() or inside.min() < 1 or (inside == last).any():
            raise NerfroError(f"{file}: the distances must be negative inside the body and positive at the border")
        self._grid = DistanceGrid(torch.from_numpy(distances), torch.from_numpy(box))
        spacing = (box[1] - box[0]) / last
        self.known, self.bounds = box, box[0] + spacing * np.stack([inside.min(0) - 1, inside.max(0) + 1])

    def distances(self, grid: Grid) -> Float[np.ndarray, "X Y Z"]:
        return np.stack([self._grid(torch.from_numpy(plane))[0].numpy() for plane in grid.points])
