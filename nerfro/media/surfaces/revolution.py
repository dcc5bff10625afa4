"""`surface: {name: revolution}`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfro.core.errors import NerfroError
from nerfro.geometry.mesh import merge_vertices
from nerfro.geometry.revolve import revolve
from nerfro.media.surface import MeshSurface, direction, vector
from nerfro.registry.allowed import Coordinate
from nerfro.registry.registration import register


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
