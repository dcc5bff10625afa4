"""Near surroundings as a panorama with depth, rendered from the centre of the object.

A radiance field has no useful gradient for the refinement of a surface, because its details are finer than the
displacements. A panorama can be blurred, and depth makes the lookup follow the exit ray.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.backgrounds import cube_map
from nerfro.backgrounds.base import Background
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.capture.surroundings import Room
from nerfro.core.rays import Rays
from nerfro.core.types import Exits
from nerfro.media.bodies import Bodies
from nerfro.samplers.paths.snell import Snell


class RoomPanorama(Background):
    """A panorama with depth around a point; the lookup intersects exit rays from other positions with the depth.

    The panorama lacks surfaces that are hidden from the point.

    Args:
        middle: centre of the panorama.
        colours: linear radiance by direction.
        distances: distance of each texel (see `cube_map.texel_directions`), world units.
    """

    def __init__(self, middle: Float[Tensor, "3"], colours: EnvironmentMap, distances: Float[Tensor, "T"]) -> None:
        super().__init__()
        self.middle, self.colours, self.distances = middle, colours, distances
        side = round((len(distances) / 6) ** 0.5)
        self._levels, self._padded = cube_map.CubeLevels((side,)), cube_map.padded_texels(side).flatten()

    def forward(self, exits: Exits) -> Float[Tensor, "P 3"]:
        """Look up the radiance along exit rays, differentiable by their positions and directions."""
        assert exits.positions is not None
        starts = exits.positions - self.middle
        with torch.no_grad():
            lengths = self._lengths(starts, exits.directions)
        return self.colours(Exits(starts + lengths * exits.directions))

    def _lengths(self, starts: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]) -> Float[Tensor, "P 1"]:
        """Intersect exit rays with the depth of the panorama by fixed-point iteration; returns arc lengths."""
        along = (starts * directions).sum(-1, keepdim=True)
        square = starts.square().sum(-1, keepdim=True)
        seen, lengths = directions, torch.zeros_like(along)
        texels = self.distances[:, None].expand(-1, 3)
        for _ in range(5):  # few suffice, because the object is small beside its surroundings
            distance = cube_map.lookup(*cube_map.project(seen), texels, self._padded, self._levels)[:, :1]
            lengths = ((along.square() - square + distance.square()).clamp(min=0).sqrt() - along).clamp(min=0)
            seen = starts + lengths * directions
        return lengths


@torch.no_grad()
def panorama_of(room: Room, medium: Bodies, middle: Float[Tensor, "3"], side: int = 192) -> RoomPanorama:
    """Render a panorama of near surroundings from the surface of an object outwards.

    Args:
        room: the surroundings.
        medium: the object.
        middle: centre of the panorama.
        side: texels per side of a face; 192 are half a degree each.
    """
    radius = float((medium.box[1] - medium.box[0]).norm())
    radiance, distances = [], []
    for directions in cube_map.texel_directions(side).split(16384):
        ones = torch.ones(len(directions))
        inwards = Rays(middle + radius * directions, -directions, 0 * ones, 0 * ones, 2 * radius * ones)
        path = Snell()(inwards, medium)
        starts = torch.where(path.refracted[:, None], path.positions[:, 1], middle)
        seen, distance = room.seen(Exits(directions, starts))
        radiance.append(seen)
        distances.append(distance + (starts - middle).norm(dim=-1))
    return RoomPanorama(middle, EnvironmentMap.of_texels(torch.cat(radiance)), torch.cat(distances))
