"""The NeRF field: positional encoding and an MLP, asked at points."""

from __future__ import annotations

from nerfro.fields.base import Field
from nerfro.fields.encoding import positional_encoding
from nerfro.fields.mlp import RadianceMLP
from nerfro.registry import register
from nerfro.types import Radiance, Samples


@register("field", "nerf")
class NerfField(Field):
    """8x256 MLP on positional encodings of position and local direction (paper, section 2; NeRF, section 5).

    Args:
        width, depth, skip, view_width: of the MLP, see `RadianceMLP`.
        position_degree: octaves of the position's encoding; positions are raw world coordinates.
        direction_degree: octaves of the direction's encoding.
        normalise: length in world units that counts as one before encoding; 1 leaves positions as they are.
    """

    def __init__(
        self,
        width: int = 256,
        depth: int = 8,
        skip: int = 5,
        view_width: int = 128,
        position_degree: int = 10,
        direction_degree: int = 4,
        normalise: float = 1.0,
    ) -> None:
        super().__init__()
        self.position_degree, self.direction_degree, self.normalise = position_degree, direction_degree, normalise
        num_position, num_direction = 3 * (1 + 2 * position_degree), 3 * (1 + 2 * direction_degree)
        self.mlp = RadianceMLP(num_position, num_direction, width, depth, skip, view_width)

    def forward(self, samples: Samples) -> Radiance:
        position = positional_encoding(samples.positions / self.normalise, 0, self.position_degree)
        direction = positional_encoding(samples.directions, 0, self.direction_degree)
        return Radiance(*self.mlp(position, direction))
