"""Models with one part changed: another sky, another index, no glass, nothing inside."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.boundaries.envmap import EnvironmentMap
from nerfro.errors import NerfroError
from nerfro.fields.base import Field
from nerfro.light import to_srgb
from nerfro.media.analytic import Vacuum
from nerfro.media.solid import Solid
from nerfro.rendering import ColourSpace, Renderer, Scene
from nerfro.samplers.straight import Straight
from nerfro.types import Radiance, Samples
from nerfro.variants import variant


class Nothing(Field):
    """A field that holds nothing."""

    def forward(self, samples: Samples) -> Radiance:
        return Radiance(torch.zeros_like(samples.s), torch.zeros_like(samples.positions))


def with_changed_scene(renderer: Renderer, **changes: nn.Module) -> Renderer:
    """The renderer of a scene with some components changed; it shares all others with the given one."""
    return variant(renderer, scene=variant(renderer.scene, **changes))


def with_sky(renderer: Renderer, radiance: Float[Tensor, "H 2*H 3"]) -> Renderer:
    """The model under a lat-long picture of linear radiance, z up."""
    if radiance.ndim != 3 or radiance.shape[1:] != (2 * len(radiance), 3):
        raise NerfroError(f"a sky of shape {list(radiance.shape)} is no lat-long picture; give one of [H, 2 H, 3]")
    # A face of the cube spans a quarter of the picture's width.
    sky, scene = EnvironmentMap([max(1, radiance.shape[1] // 4)]), renderer.scene
    sky.set_lat_long(to_srgb(radiance) if scene.colour_space is ColourSpace.SRGB else radiance)
    return with_changed_scene(renderer, boundary=sky.to(scene.device).eval())


def with_indices(renderer: Renderer, ior: Float[Tensor, "*K"]) -> Renderer:
    """The model with other refractive indices: one for each body, or one number for the outer body."""
    medium = renderer.scene.medium
    return with_changed_scene(renderer, medium=medium.with_indices(_of_bodies(ior, medium.indices, "ior")))


def with_absorption(renderer: Renderer, absorption: Float[Tensor, "*K 3"]) -> Renderer:
    """The model with other absorption coefficients: three for each body, or for the outer body."""
    medium = renderer.scene.medium
    if not (isinstance(medium, Solid) and hasattr(medium, "absorption")):
        raise NerfroError(f"{type(medium).__name__} absorbs no light: it has no bodies of constant absorption")
    given = _of_bodies(absorption, absorption_of(renderer.scene), "absorption")
    return with_changed_scene(renderer, medium=variant(medium, _absorption=given.to(renderer.scene.device)))


def absorption_of(scene: Scene) -> Float[Tensor, "K 3"]:
    """Absorption of red, green and blue in each body, per world unit, on the CPU; 0 where all are clear."""
    known = getattr(scene.medium, "absorption", None)
    return torch.zeros(len(scene.medium.indices), 3) if known is None else known.detach().float().cpu()


def without_glass(renderer: Renderer) -> Renderer:
    """The model with straight rays."""
    vacuum = Vacuum().to(renderer.scene.device)
    return variant(with_changed_scene(renderer, medium=vacuum), path_sampler=Straight())


def without_inside(renderer: Renderer) -> Renderer:
    """The model with glass and sky alone."""
    return with_changed_scene(renderer, fields=nn.ModuleList(Nothing() for _ in renderer.scene.fields))


def _of_bodies(given: Tensor, known: Tensor, what: str) -> Tensor:
    """Values for all bodies of those that are given: for each, or for the outer one alone."""
    given = given.to(known)
    if not len(known):
        raise NerfroError(f"{what} cannot be set: the model has no bodies on which rays bend")
    if given.shape == known.shape[1:]:
        given = torch.cat([given[None], known[1:]])
    if given.shape != known.shape or not torch.isfinite(given).all() or (given < 0).any():
        raise NerfroError(f"{what}={given.tolist()} is not allowed; give {list(known.shape)} positive numbers")
    return given
