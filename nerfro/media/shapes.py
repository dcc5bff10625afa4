"""Solids with a signed distance in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerfro.allowed import NotNegative, Positive
from nerfro.media.base import Vectors
from nerfro.media.solid import Solid
from nerfro.registry import register

# Air around a shape as a share of its size, because half of the shell lies outside the surface.
_MARGIN = 0.05
# Slab: half side of the box along x and y, world units, larger than the scenes of the paper.
_HALF_WIDTH = 10.0


@register("medium", "ball")
class Ball(Solid):
    """A ball around the origin.

    Args:
        radius: of the ball, world units.
        ior, shell, absorption, learn_absorption, abbe: see `Solid`.
    """

    def __init__(
        self,
        radius: Positive = 0.8,
        ior: Positive = 1.5,
        shell: Positive = 0.002,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
        abbe: Sequence[Positive] = (),
    ) -> None:
        super().__init__([ior], shell, absorption, learn_absorption, abbe)
        self.radius = radius
        side = radius * (1 + _MARGIN) + shell
        self.register_buffer("box", torch.tensor([[-side] * 3, [side] * 3]), persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Return |x| - R and x / |x|."""
        distance = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
        return distance - self.radius, functional.normalize(positions, dim=-1)[..., None, :]


@register("medium", "rounded_box")
class RoundedBox(Solid):
    """A cube around the origin with rounded edges and corners.

    Args:
        half_side: distance from the centre to a face, world units.
        edge_radius: radius of the rounded edges, world units.
        ior, shell, absorption, learn_absorption, abbe: see `Solid`.
    """

    def __init__(
        self,
        half_side: Positive = 0.75,
        edge_radius: NotNegative = 0.08,
        ior: Positive = 1.52,
        shell: Positive = 0.002,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
        abbe: Sequence[Positive] = (),
    ) -> None:
        super().__init__([ior], shell, absorption, learn_absorption, abbe)
        self.half_side, self.edge_radius = half_side, edge_radius
        side = half_side * (1 + _MARGIN) + shell
        self.register_buffer("box", torch.tensor([[-side] * 3, [side] * 3]), persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Return |max(q, 0)| + min(max q, 0) - r with q = |x| - (a - r): the distance to a smaller cube, less r."""
        q = positions.abs() - (self.half_side - self.edge_radius)
        outward = q.clamp(min=0)
        outside = torch.linalg.vector_norm(outward, dim=-1, keepdim=True)
        distance = outside + q.amax(-1, keepdim=True).clamp(max=0) - self.edge_radius
        nearest_face = functional.one_hot(q.argmax(-1), 3).to(q)
        direction = torch.where(outside > 0, functional.normalize(outward, dim=-1), nearest_face)
        return distance, (direction * positions.sign())[..., None, :]


@register("medium", "slab")
class Slab(Solid):
    """A plate across the z axis that fills the medium's box along x and y.

    Args:
        thickness: along z, world units.
        ior, shell, absorption, learn_absorption, abbe: see `Solid`.
    """

    def __init__(
        self,
        thickness: Positive = 0.5,
        ior: Positive = 1.5,
        shell: Positive = 0.002,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
        abbe: Sequence[Positive] = (),
    ) -> None:
        super().__init__([ior], shell, absorption, learn_absorption, abbe)
        self.thickness = thickness
        corner = torch.tensor([_HALF_WIDTH, _HALF_WIDTH, thickness * (0.5 + _MARGIN) + shell])
        self.register_buffer("box", torch.stack([-corner, corner]), persistent=False)

    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Return |z| - h / 2 and the sign of z."""
        z = positions[..., 2:]
        normal = torch.cat([torch.zeros_like(positions[..., :2]), z.sign()], -1)
        return z.abs() - 0.5 * self.thickness, normal[..., None, :]
