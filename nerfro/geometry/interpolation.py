"""Interpolation on regular grids whose vertices include both ends of the box."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def trilinear(
    table: Float[Tensor, "X Y Z C"], box: Float[Tensor, "2 3"], positions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch C"]:
    """Interpolate all channels of a grid linearly along each axis; positions outside take the border's values.

    Args:
        table: values at the grid's vertices.
        box: lower and upper corner of the grid, world units.
        positions: points, world units.
    """
    shape = torch.tensor(table.shape[:3], device=table.device)
    scale = (shape - 1) / (box[1] - box[0])
    coordinates = ((positions - box[0]) * scale).reshape(-1, 3)
    coordinates = torch.minimum(coordinates.clamp(min=0), (shape - 1).to(coordinates))
    cell = torch.minimum(coordinates.long(), shape - 2)
    fraction = (coordinates - cell)[..., None]
    flat = table.reshape(-1, table.shape[-1])
    stride_x, stride_y = table.shape[1] * table.shape[2], table.shape[2]
    corner = cell[:, 0] * stride_x + cell[:, 1] * stride_y + cell[:, 2]
    fx, fy, fz = fraction.unbind(1)

    def along_z(start: Tensor) -> Tensor:
        return torch.lerp(flat[start], flat[start + 1], fz)

    def along_y(start: Tensor) -> Tensor:
        return torch.lerp(along_z(start), along_z(start + stride_y), fy)

    values = torch.lerp(along_y(corner), along_y(corner + stride_x), fx)
    return values.reshape(*positions.shape[:-1], table.shape[-1])


def intersect_box(
    box: Float[Tensor, "2 3"], origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]
) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
    """Distances at which lines enter and leave a box; the first exceeds the second where they miss it."""
    # A component of zero gives infinities of both signs, which min and max sort out, except 0 * inf = nan on a face.
    inverse = 1.0 / directions
    to_low, to_high = (box[0] - origins) * inverse, (box[1] - origins) * inverse
    enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf, torch.inf, -torch.inf).amax(-1)
    leave = torch.maximum(to_low, to_high).nan_to_num(torch.inf, torch.inf, -torch.inf).amin(-1)
    return enter, leave
