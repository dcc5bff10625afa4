"""mip-NeRF (Barron et al., "Mip-NeRF: A multiscale representation for anti-aliasing neural radiance fields", 2021).

The baseline `+experiment=mipnerf` consists of `field=mip_nerf`, an MLP on the integrated positional encoding of conical
frustums, and of `model=mip_nerf`.
"""

from __future__ import annotations

from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from nerfro.core.types import Batch, FieldValues, Path, Rendering, Samples
from nerfro.paper.mlp import in_blocks, integrated_positional_encoding
from nerfro.paper.nerf import EncodedField
from nerfro.registry.allowed import Depth
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer, composite


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
