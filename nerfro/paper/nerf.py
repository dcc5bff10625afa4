"""The field of NeRF, an MLP on positional encodings of points, mip-NeRF, and the skybox of the paper.

The baseline `+experiment=mipnerf` (Barron et al., "Mip-NeRF: A multiscale representation for anti-aliasing neural
radiance fields", 2021) consists of `field=mip_nerf`, an MLP on the integrated positional encoding of conical frustums,
and of `model=mip_nerf`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from nerfro.backgrounds.base import Background
from nerfro.core.compositing import composite
from nerfro.core.types import Batch, Exits, FieldValues, Path, Rendering, Samples
from nerfro.data.base import Views
from nerfro.fields.base import Field, evaluate_selected
from nerfro.geometry.space import Space, Unbounded
from nerfro.paper.mlp import (
    DIRECTION_DEGREE,
    RadianceMLP,
    SkipMLP,
    glorot_linear,
    in_blocks,
    integrated_positional_encoding,
    padded_sigmoid,
    positional_encoding,
)
from nerfro.registry.allowed import Depth, Positive, Width
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer


class EncodedField(Field):
    """A field that evaluates an MLP on encodings of positions in world coordinates, and of directions.

    Args:
        width, depth, skip, view_width: shape of the MLP, see `RadianceMLP`.
        position_degree: number of octaves of the encoding of positions.
        unit: length of the encoded positions and of the density, world units. The authors use 1. In a configuration,
            None takes a quarter of the distance from near to far, so that the world unit is irrelevant.
        space: space that the field covers; None for all of space.

    Attributes:
        num_coordinates: number of coordinates that the encoding of positions includes.
    """

    num_coordinates = 0

    def __init__(
        self,
        width: Width = 256,
        depth: Depth = 8,
        skip: int = 5,
        view_width: Width = 128,
        position_degree: int = 16,
        unit: Positive | None = 1.0,
        space: Space | None = None,
    ) -> None:
        super().__init__()
        self.position_degree = position_degree
        self.unit = 1.0 if unit is None else unit
        self.space = Unbounded() if space is None else space
        num_position, num_direction = self.num_coordinates + 6 * position_degree, 3 * (1 + 2 * DIRECTION_DEGREE)
        self.mlp = RadianceMLP(num_position, num_direction, width, depth, skip, view_width)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        views.refuse_linear_light("the networks of NeRF and mip-NeRF")
        # From near to far are 4 units in the scenes of NeRF, for which its encoding of positions is made.
        return {"unit": (views.cameras.far - views.cameras.near) / 4.0}

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return self.space.bounds

    def decode_encoded(
        self, position: Float[Tensor, "points F"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density and colour for encoded positions and unit directions."""
        density, radiance = self.mlp(position, positional_encoding(directions, DIRECTION_DEGREE))
        return density / self.unit, radiance


@register("field", "nerf")
class NerfField(EncodedField):
    """8x256 MLP on positional encodings of position and local direction (paper, section 2; NeRF, section 5).

    Args:
        position_degree: number of octaves of the encoding of positions.
        options: see `EncodedField`. The field is empty outside a box, and samples there are not evaluated.
    """

    num_coordinates = 3

    def __init__(self, position_degree: Annotated[int, Ge(0), Le(64)] = 10, **options: Any) -> None:
        super().__init__(position_degree=position_degree, **options)

    def forward(self, samples: Samples) -> FieldValues:
        return evaluate_selected(self.decode, samples, self.space.inside(samples.positions))

    def decode(
        self, positions: Float[Tensor, "*batch 3"], directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """Evaluate density and colour at positions for unit directions."""
        return in_blocks(self._decode_block, positions, directions)

    def _decode_block(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        return self.decode_encoded(positional_encoding(positions / self.unit, self.position_degree), directions)


@register("background", "skybox")
class Skybox(Background):
    """Represent the background by a 4x128 MLP of the encoded exit direction (paper, Eqn. 5, F_psi).

    The radiance is a sigmoid and at most 1, as in the authors' code. Bright lamps are therefore clipped.

    Args:
        width: number of units in each hidden layer.
        depth: number of hidden layers.
        skip: number of the layer after which the input is concatenated again.
    """

    def __init__(self, width: Width = 128, depth: Depth = 4, skip: int = 3) -> None:
        super().__init__()
        self.trunk = SkipMLP(3 * (1 + 2 * DIRECTION_DEGREE), width, depth, skip)
        self.rgb = glorot_linear(self.trunk.num_outputs, 3)

    @classmethod
    def derive(cls, settings: DictConfig, views: Views, space: Space) -> dict[str, Any]:
        views.refuse_linear_light("background=skybox")
        return {}

    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        return padded_sigmoid(self.rgb(self.trunk(positional_encoding(exits.directions, DIRECTION_DEGREE))))


@register("field", "mip_nerf")
class MipNerfField(EncodedField):
    """8x256 MLP on the expected encoding of each sample's frustum (mip-NeRF, section 3); needs `cast=cones`.

    Args:
        position_degree: number of octaves of the integrated encoding, which damps octaves finer than the frustum.
        options: see `EncodedField`.
    """

    def __init__(self, position_degree: Depth = 16, **options: Any) -> None:
        super().__init__(position_degree=position_degree, **options)

    def forward(self, samples: Samples) -> FieldValues:
        density, radiance = in_blocks(self._decode_block, *frustum_gaussians(samples), samples.directions)
        if (inside := self.space.inside(samples.positions)) is not None:
            density, radiance = density * inside, radiance * inside[..., None]
        return FieldValues(density, radiance)

    def _decode_block(
        self,
        mean: Float[Tensor, "points 3"],
        variance: Float[Tensor, "points 3"],
        directions: Float[Tensor, "points 3"],
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        position = integrated_positional_encoding(mean / self.unit, variance / self.unit**2, self.position_degree)
        return self.decode_encoded(position, directions)


def frustum_gaussians(samples: Samples) -> tuple[Float[Tensor, "P N 3"], Float[Tensor, "P N 3"]]:
    """Return mean and diagonal covariance of each sample's conical frustum.

    mip-NeRF, Eqns. 7 and 16, in numerically stable form. On a bent path the cone follows the local direction and
    widens with arc length, which neglects the focusing by the medium.
    """
    near, far = samples.edges[:, :-1], samples.edges[:, 1:]
    mu, half = 0.5 * (near + far), 0.5 * (far - near)
    denominator = 3 * mu**2 + half**2
    shift = 2 * mu * half**2 / denominator
    along = half**2 / 3 - (4 / 15) * half**4 * (12 * mu**2 - half**2) / denominator**2
    across = samples.radii[:, None] ** 2 * (mu**2 / 4 + (5 / 12) * half**2 - (4 / 15) * half**4 / denominator)
    mean = samples.positions + (mu + shift - samples.s)[..., None] * samples.directions
    squared = samples.directions**2
    variance = along[..., None] * squared + across[..., None] * (1 - squared)
    return mean, variance


@register("model", "mip_nerf")
class MipNerfModel(Renderer):
    """Render straight rays with one radiance field for all sampling levels, as mip-NeRF, and a background.

    Args:
        colour: see `model=refractive`.
    """

    empty_shows_background = True

    def __init__(self, components: Components, colour: Literal["linear", "srgb"] = "linear") -> None:
        super().__init__(components, 1, colour)

    def render_path(self, path: Path, batch: Batch | None = None) -> list[Rendering]:
        background_radiance = self.background(path, batch)
        (field,) = self.scene.fields
        renderings: list[Rendering] = []
        for _ in range(self.point_sampler.num_levels):
            samples = self.sample(path, renderings[-1] if renderings else None, batch)
            renderings.append(composite(samples, field(samples), background_radiance, path))
        return renderings
