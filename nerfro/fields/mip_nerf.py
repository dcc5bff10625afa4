"""The mip-NeRF field: integrated positional encoding of conical frustums and an MLP."""

from __future__ import annotations

from nerfro.allowed import Count, Natural
from nerfro.fields.base import Field
from nerfro.fields.cones import frustum_gaussians
from nerfro.fields.encoding import integrated_positional_encoding, positional_encoding
from nerfro.fields.mlp import RadianceMLP
from nerfro.registry import register
from nerfro.types import Radiance, Samples


@register("field", "mip_nerf")
class MipNerfField(Field):
    """8x256 MLP on the expected encoding of each sample's frustum (mip-NeRF, section 3); wants `cast=cones`.

    Args:
        width, depth, skip, view_width: of the MLP, see `RadianceMLP`.
        position_degree: octaves of the integrated encoding, which damps those finer than the frustum.
        direction_degree: octaves of the direction's encoding.
    """

    def __init__(
        self,
        width: Count = 256,
        depth: Count = 8,
        skip: int = 5,
        view_width: Count = 128,
        position_degree: Count = 16,
        direction_degree: Natural = 4,
    ) -> None:
        super().__init__()
        self.position_degree, self.direction_degree = position_degree, direction_degree
        num_position, num_direction = 6 * position_degree, 3 * (1 + 2 * direction_degree)
        self.mlp = RadianceMLP(num_position, num_direction, width, depth, skip, view_width)

    def forward(self, samples: Samples) -> Radiance:
        mean, variance = frustum_gaussians(samples)
        position = integrated_positional_encoding(mean, variance, 0, self.position_degree)
        direction = positional_encoding(samples.directions, 0, self.direction_degree)
        return Radiance(*self.mlp(position, direction))
