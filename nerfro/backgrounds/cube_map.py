"""An equi-angular cube map with several resolutions, in plain PyTorch.

Face 2 a + b is the side of the cube at the positive (b = 0) or negative (b = 1) end of axis a. The first texture
coordinate of a face is the angle towards axis a + 1 (modulo 3), and the second the angle towards axis a + 2. All texels
have the same width in angle, which keeps their solid angles within a factor of 1.4.

`lookup` runs on GPUs, and is the reference implementation of the kernels in `nerfro.backgrounds.cube_map_cpu`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerfro.kernels.constants import constant


@dataclass(frozen=True)
class CubeLevels:
    """Layout of the texels of all levels in one list; each level is ordered by face, row and column."""

    resolutions: tuple[int, ...]  # texels along a face's side

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        return tuple(6 * n * n for n in self.resolutions)

    @cached_property
    def padded_sizes(self) -> tuple[int, ...]:
        """Number of texels of each level with margins, see `padded_texels`."""
        return tuple(6 * (n + 2) ** 2 for n in self.resolutions)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        return tuple(sum(self.sizes[:level]) for level in range(len(self.resolutions)))

    @cached_property
    def num_texels(self) -> int:
        return sum(self.sizes)

    @cached_property
    def num_padded(self) -> int:
        return sum(self.padded_sizes)

    def __len__(self) -> int:
        return len(self.resolutions)


def project(directions: Float[Tensor, "P 3"]) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 2"]]:
    """Return the face that a direction hits and the texture coordinates in [-1, 1], which are linear in angle."""
    axis = directions.abs().argmax(-1, keepdim=True)
    main = directions.gather(-1, axis)
    across = directions.gather(-1, torch.cat([axis + 1, axis + 2], dim=-1) % 3)
    face = 2 * axis + (main < 0)
    return face.squeeze(-1), torch.atan(across / main.abs()) * (4 / math.pi)


def unproject(face: Int[Tensor, "P"], coordinates: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Return the unit direction at texture coordinates of a face; the inverse of `project`.

    Coordinates may exceed [-1, 1] by up to 1; such points lie on the extended plane of the face.
    """
    axis = torch.div(face, 2, rounding_mode="floor")
    sign = 1.0 - 2.0 * (face % 2)
    across = torch.tan(coordinates * (math.pi / 4))
    components = torch.cat([sign.to(across)[:, None], across], dim=-1)
    # Component k of the result is number k - axis of (main, first, second).
    order = (torch.arange(3, device=face.device) - axis[:, None]) % 3
    return torch.nn.functional.normalize(components.gather(-1, order), dim=-1)


def texel_directions(resolution: int) -> Float[Tensor, "T 3"]:
    """Return the unit directions of the texel centres of one level."""
    return _directions((torch.arange(resolution) + 0.5) / resolution * 2 - 1)


def padded_texels(resolution: int) -> Int[Tensor, "6 m m"]:
    """Return the texel at each place of the faces, with a margin of one texel from the neighbouring faces.

    Three faces meet at a corner, where no fourth texel exists. The corners of the margin are therefore not valid.
    """
    n = resolution
    # In double precision, because texels beside a corner project almost to the border of the neighbouring face.
    directions = _directions((torch.arange(-1, n + 1, dtype=torch.float64) + 0.5) / n * 2 - 1)
    return nearest_texel(directions, n).view(6, n + 2, n + 2).int()


def nearest_texel(directions: Float[Tensor, "P 3"], resolution: int) -> Int[Tensor, "P"]:
    """Return the texel of one level that each direction hits."""
    (face, coordinates), n = project(directions), resolution
    column, row = ((coordinates + 1) / 2 * n).long().clamp(0, n - 1).unbind(-1)
    return (face * n + row) * n + column


def _directions(centres: Float[Tensor, "n"]) -> Float[Tensor, "T 3"]:
    """Return the directions of a grid of coordinates on all faces, ordered by face, row and column."""
    n = len(centres)
    face = torch.arange(6).repeat_interleave(n * n)
    row, column = (place.flatten().repeat(6) for place in torch.meshgrid(centres, centres, indexing="ij"))
    return unproject(face, torch.stack([column, row], dim=-1))


def lookup(
    face: Int[Tensor, "P"],
    coordinates: Float[Tensor, "P 2"],
    texels: Float[Tensor, "T 3"],
    padded: Int[Tensor, " padded"],
    levels: CubeLevels,
) -> Float[Tensor, "P 3"]:
    """Sum the bilinear interpolations of all levels, which are continuous over the sphere.

    The result is differentiable with respect to the texels and, between texel centres, to the coordinates.

    Args:
        face, coordinates: see `project`.
        texels: of all levels.
        padded: `padded_texels` of all levels, flattened, one level after the other.
        levels: layout of the texels.
    """
    padded_offsets = tuple(sum(levels.padded_sizes[:level]) for level in range(len(levels)))
    resolution, offset, padded_offset = (
        constant(values, texels.device) for values in (levels.resolutions, levels.offsets, padded_offsets)
    )
    position = (coordinates[:, None] + 1) * (0.5 * resolution[:, None]) + 0.5  # in padded texels, with integer centres
    corner = torch.minimum(position.long().clamp(min=0), resolution[:, None])
    (u, v), (column, row) = (position - corner).unbind(-1), corner.unbind(-1)
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
    # The gradient of index_select is one index_add; that of indexing with brackets sorts all indices first.
    return (texels.index_select(0, texel.flatten()).view(*texel.shape, 3) * weights[..., None]).sum((1, 2))
