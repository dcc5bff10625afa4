"""`surface: {name: revolution}`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfro.allowed import Coordinate
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import merge_vertices
from nerfro.geometry.revolve import revolve
from nerfro.media.surface import MeshSurface, direction
from nerfro.registry import register

from .vectors import vector


@register("surface", "revolution")
class RevolutionSurface(MeshSurface):
    """A body of revolution with a given profile, such as a cylinder, a lens or a bottle.

    Edges of the profile are smooth up to 30 degrees, so few points describe a curve.

    Args:
        profile: [radius, height] of points along the outline, from one end of the axis to the other, world units. Ends
            away from the axis get flat faces. If the last point is the first one, the outline is a ring.
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
        if (points[0] != points[-1]).any():
            points = np.concatenate([points[:1] * [0, 1], points, points[-1:] * [0, 1]])
        inner, outer = points[:-1, 0], points[1:, 0]
        if (np.diff(points[:, 1]) * (inner**2 + inner * outer + outer**2)).sum() < 0:  # the volume, with its sign
            points = points[::-1]
        mesh = revolve(points, vector("centre", centre), direction("surface.axis", axis))
        self._set(merge_vertices(mesh.vertices, mesh.faces))
