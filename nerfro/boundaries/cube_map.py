"""An equi-angular cube map with several resolutions, in plain PyTorch.

Face 2 a + b is the side of the cube that the axis a pierces, on the positive end for b = 0 and on the negative one for
b = 1. Its first texture coordinate is the angle towards the axis a + 1 (modulo 3), its second towards a + 2; texels are
equally wide in angle, which keeps their solid angles within a factor of 1.4.

The compiled kernels in `nerfro.boundaries.cube_map_cpu` are tested against `lookup`, which is also the path on a GPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.kernels.constants import constant


@dataclass(frozen=True)
class CubeLevels:
    """Where the texels of each level lie in one list; within a level ordered by face, row and column."""

    resolutions: tuple[int, ...]  # texels along a face's side

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(6 * n * n for n in self.resolutions)

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(sum(self.sizes[:level]) for level in range(len(self.resolutions)))

    @property
    def num_texels(self) -> int:
        return sum(self.sizes)

    @property
    def num_padded(self) -> int:
        """Of places of the faces grown by one texel on every side, see `padded_texels`."""
        return sum(6 * (n + 2) ** 2 for n in self.resolutions)

    def __len__(self) -> int:
        return len(self.resolutions)


def project(directions: Float[Tensor, "P 3"]) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 2"]]:
    """The face that a direction pierces, and where: texture coordinates in [-1, 1], equal steps in angle."""
    axis = directions.abs().argmax(-1, keepdim=True)
    main = directions.gather(-1, axis)
    across = directions.gather(-1, torch.cat([axis + 1, axis + 2], dim=-1) % 3)
    face = 2 * axis + (main < 0)
    return face.squeeze(-1), torch.atan(across / main.abs()) * (4 / math.pi)


def unproject(face: Int[Tensor, "P"], coordinates: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """The unit direction at texture coordinates of a face; the inverse of `project`.

    Coordinates may lie up to one beyond [-1, 1]: the face's plane continues.
    """
    axis = torch.div(face, 2, rounding_mode="floor")
    sign = 1.0 - 2.0 * (face % 2)
    across = torch.tan(coordinates * (math.pi / 4))
    components = torch.cat([sign.to(across)[:, None], across], dim=-1)
    # Component k of the result is number k - axis of (main, first, second).
    order = (torch.arange(3, device=face.device) - axis[:, None]) % 3
    return torch.nn.functional.normalize(components.gather(-1, order), dim=-1)


def texel_directions(resolution: int) -> Float[Tensor, "T 3"]:
    """Directions of the texels' centres."""
    return _directions((torch.arange(resolution) + 0.5) / resolution * 2 - 1)


def padded_texels(resolution: int) -> Int[Tensor, "6 m m"]:
    """The texel at each place of the faces, grown by one texel on every side with those of the neighbouring faces.

    At the faces' corners three faces meet and there is no fourth texel: these places are not to be used.
    """
    n = resolution
    # In double precision, because texels beside a corner project to almost the border of their neighbour.
    face, coordinates = project(_directions((torch.arange(-1, n + 1, dtype=torch.float64) + 0.5) / n * 2 - 1))
    column, row = ((coordinates + 1) / 2 * n).long().clamp(0, n - 1).unbind(-1)
    return ((face * n + row) * n + column).view(6, n + 2, n + 2).int()


def _directions(centres: Float[Tensor, "n"]) -> Float[Tensor, "T 3"]:
    """Directions at all faces' places with the given coordinates, by face, row and column."""
    n = len(centres)
    face = torch.arange(6).repeat_interleave(n * n)
    row, column = (place.flatten().repeat(6) for place in torch.meshgrid(centres, centres, indexing="ij"))
    return unproject(face, torch.stack([column, row], dim=-1))


def lookup(
    face: Int[Tensor, "P"],
    coordinates: Float[Tensor, "P 2"],
    texels: Float[Tensor, "T 3"],
    padded: Int[Tensor, "Q"],
    levels: CubeLevels,
) -> Float[Tensor, "P 3"]:
    """Bilinear lookups of all levels, summed; continuous over the whole sphere.

    Differentiable in the texels and, between their centres, in the coordinates.
    `padded` are the `padded_texels` of all levels, flattened one after the other.
    """
    padded_sizes = [6 * (n + 2) ** 2 for n in levels.resolutions]
    padded_offsets = tuple(sum(padded_sizes[:level]) for level in range(len(levels)))
    resolution, offset, padded_offset = (
        constant(values, texels.device) for values in (levels.resolutions, levels.offsets, padded_offsets)
    )
    place = (coordinates[:, None] + 1) * (0.5 * resolution[:, None]) + 0.5  # of padded texels, with integer centres
    corner = torch.minimum(place.long().clamp(min=0), resolution[:, None])
    (u, v), (column, row) = (place - corner).unbind(-1), corner.unbind(-1)
    weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=-1)
    # Where three faces meet, the missing fourth texel is the mean of the three.
    ends = (0, resolution)
    missing = torch.stack([(column == c) & (row == r) for r in ends for c in ends], dim=-1)
    absent = (weights * missing).sum(-1, keepdim=True)
    weights = torch.where(missing, 0.0, weights + absent / 3)
    width = resolution + 2
    first = padded_offset + (face[:, None] * width + row) * width + column
    index = torch.stack([first, first + 1, first + width, first + width + 1], dim=-1)
    texel = padded.index_select(0, index.flatten()).view(index.shape) + offset[:, None]
    # index_select, because its gradient is one index_add: indexing with brackets would sort all indices first.
    return (texels.index_select(0, texel.flatten()).view(*texel.shape, 3) * weights[..., None]).sum((1, 2))
