"""Surroundings of the box on grids, which are blurred at first and sharpened level by level."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.types import Exits, FieldValues, Samples
from nerfro.fields.base import Field
from nerfro.geometry.interpolation import smooth, trilinear
from nerfro.geometry.space import inside_box

# Directions are looked up on the unit sphere in a grid over this cube.
_SKY_SIDE = 1.1
_POINTS_AT_ONCE = 65536


@dataclass(frozen=True)
class BackgroundGrids:
    """Radiance outside a box, and the background, on grids that are differentiable in position and direction.

    Attributes:
        radiance: radiance and density at the vertices over `box`.
        box: corners, world units.
        sky: radiance of the background in the direction of each vertex of a cube around the origin.
    """

    radiance: Float[Tensor, "X Y Z 4"]
    box: Float[Tensor, "2 3"]
    sky: Float[Tensor, "X Y Z 3"]

    @classmethod
    @torch.no_grad()
    def fit(
        cls,
        field: Field,
        background: Background,
        box: Float[Tensor, "2 3"],
        hidden: Float[Tensor, "2 3"],
        resolution: int,
    ) -> BackgroundGrids:
        """Evaluate a field and a background model at the vertices of grids.

        The colour of the field is the mean over the six axis directions.

        Args:
            field, background: field and background model of the scene.
            box: box of the grid of the field, world units.
            hidden: box inside of which the grid is empty.
            resolution: vertices along each side.
        """
        vertices = _vertices(box, resolution)
        radiance = vertices.new_zeros(len(vertices), 4)
        outside = (~inside_box(vertices, *hidden)).nonzero().squeeze(1)
        for index in outside.split(_POINTS_AT_ONCE):
            radiance[index] = _mean_radiance(field, vertices[index])
        directions = torch.nn.functional.normalize(_vertices(_cube(box.device), resolution), dim=-1)
        sky = torch.cat([background(Exits(chunk)).float() for chunk in directions.split(_POINTS_AT_ONCE)])
        sides = (resolution,) * 3
        return cls(radiance.view(*sides, 4), box, sky.view(*sides, 3))

    def blurred(self, sigma: float) -> BackgroundGrids:
        """Convolve both grids with a Gaussian of standard deviation `sigma`, voxels."""
        size = 2 * math.ceil(3 * sigma) + 1
        return BackgroundGrids(smooth(self.radiance, size, sigma), self.box, smooth(self.sky, size, sigma))

    def radiance_at(self, samples: Samples) -> FieldValues:
        """Look up density and colour at samples."""
        values = trilinear(self.radiance, self.box, samples.positions)
        return FieldValues(values[..., 3], values[..., :3])

    def sky_towards(self, directions: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Look up the colour of the background in unit directions."""
        return trilinear(self.sky, _cube(directions.device), directions)


def _cube(device: torch.device) -> Float[Tensor, "2 3"]:
    """Return the corners of the cube of the sky, on a device."""
    return torch.tensor([[-_SKY_SIDE] * 3, [_SKY_SIDE] * 3], device=device)


def _vertices(box: Float[Tensor, "2 3"], resolution: int) -> Float[Tensor, "points 3"]:
    ticks = torch.linspace(0, 1, resolution, device=box.device)
    return box[0] + torch.cartesian_prod(ticks, ticks, ticks) * (box[1] - box[0])


def _mean_radiance(field: Field, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 4"]:
    total = positions.new_zeros(len(positions), 4)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(positions.device)
    for axis in axes:
        density, radiance = field.at_points(positions, axis.expand_as(positions))
        total += torch.cat([radiance, density[:, None]], -1) / len(axes)
    return total
