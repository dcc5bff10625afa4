"""The field of NeRF: an MLP on positional encodings of points."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Annotated

import torch
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import FieldValues, Samples
from nerfro.fields.base import Field
from nerfro.fields.selection import evaluate_selected, inside_box
from nerfro.geometry.box import corners_of_box
from nerfro.paper.encoding import DIRECTION_DEGREE, positional_encoding
from nerfro.paper.mlp import RadianceMLP, in_blocks
from nerfro.registry.allowed import AnyNumber, Depth, Positive, Width
from nerfro.registry.registration import register


class FieldInBox(Field):
    """A field that is empty outside of a box.

    Args:
        box_min, box_max: opposite corners, world units; with infinite corners, the field covers all of space.
        unit: length of the encoded positions and of the density, world units.
    """

    box: Float[Tensor, "2 3"]

    def __init__(self, box_min: Sequence[float], box_max: Sequence[float], unit: float | None = 1.0) -> None:
        super().__init__()
        self.unit = 1.0 if unit is None else unit
        box = corners_of_box(box_min, box_max, bounded=False)
        self.register_buffer("box", torch.from_numpy(box).float(), persistent=False)
        self.everywhere = not self.box.isfinite().any()

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return None if self.everywhere else self.box


@register("field", "nerf")
class NerfField(FieldInBox):
    """8x256 MLP on positional encodings of position and local direction (paper, section 2; NeRF, section 5).

    Args:
        width, depth, skip, view_width: shape of the MLP, see `RadianceMLP`.
        position_degree: number of octaves of the encoding of positions.
        box_min, box_max: opposite corners of the bounds of the scene, world units. The field is empty outside, and
            samples there are not evaluated. With infinite corners, all samples are evaluated, as in the authors' code.
        unit: length of the encoded positions and of the density, world units. The authors use 1. In a configuration,
            None takes a quarter of the distance from near to far, so that the world unit is irrelevant.
    """

    def __init__(
        self,
        width: Width = 256,
        depth: Depth = 8,
        skip: int = 5,
        view_width: Width = 128,
        position_degree: Annotated[int, Ge(0), Le(64)] = 10,
        box_min: list[AnyNumber] = (-inf, -inf, -inf),  # type: ignore[assignment]
        box_max: list[AnyNumber] = (inf, inf, inf),  # type: ignore[assignment]
        unit: Positive | None = 1.0,
    ) -> None:
        super().__init__(box_min, box_max, unit)
        self.position_degree = position_degree
        num_position, num_direction = 3 * (1 + 2 * position_degree), 3 * (1 + 2 * DIRECTION_DEGREE)
        self.mlp = RadianceMLP(num_position, num_direction, width, depth, skip, view_width)

    def forward(self, samples: Samples) -> FieldValues:
        if self.everywhere:
            return FieldValues(*self.decode(samples.positions, samples.directions))
        return evaluate_selected(self.decode, samples, inside_box(samples.positions, *self.box))

    def decode(
        self, positions: Float[Tensor, "*batch 3"], directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Evaluate density and colour at positions for unit directions."""
        return in_blocks(self._decode_block, positions, directions)

    def _decode_block(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        position = positional_encoding(positions / self.unit, self.position_degree)
        direction = positional_encoding(directions, DIRECTION_DEGREE)
        density, radiance = self.mlp(position, direction)
        return density / self.unit, radiance
