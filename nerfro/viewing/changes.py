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
from nerfro.models.base import NerfModel
from nerfro.samplers.straight import Straight
from nerfro.types import Radiance, Samples
from nerfro.variants import variant


class Nothing(Field):
    """A field that holds nothing."""

    def forward(self, samples: Samples) -> Radiance:
        return Radiance(torch.zeros_like(samples.s), torch.zeros_like(samples.positions))


def with_sky(model: NerfModel, radiance: Float[Tensor, "H 2*H 3"]) -> NerfModel:
    """The model under a lat-long picture of linear radiance, z up."""
    if radiance.ndim != 3 or radiance.shape[1:] != (2 * len(radiance), 3):
        raise NerfroError(f"a sky of shape {list(radiance.shape)} is no lat-long picture; give one of [H, 2 H, 3]")
    # A face of the cube spans a quarter of the picture's width.
    sky = EnvironmentMap([max(1, radiance.shape[1] // 4)])
    sky.set_lat_long(to_srgb(radiance) if model.colour == "srgb" else radiance)
    return variant(model, boundary=sky.to(model.device).eval())


def with_indices(model: NerfModel, ior: Float[Tensor, "*K"]) -> NerfModel:
    """The model with other refractive indices: one for each body, or one number for the outer body."""
    return variant(model, medium=model.medium.with_indices(_of_bodies(model, ior, model.medium.indices, "ior")))


def with_absorption(model: NerfModel, absorption: Float[Tensor, "*K 3"]) -> NerfModel:
    """The model with other absorption coefficients: three for each body, or for the outer body."""
    if not (isinstance(model.medium, Solid) and hasattr(model.medium, "absorption")):
        raise NerfroError(f"{type(model.medium).__name__} absorbs no light: it has no bodies of constant absorption")
    given = _of_bodies(model, absorption, absorption_of(model), "absorption")
    return variant(model, medium=variant(model.medium, _absorption=given.to(model.device)))


def absorption_of(model: NerfModel) -> Float[Tensor, "K 3"]:
    """Absorption of red, green and blue in each body, per world unit, on the CPU; 0 where all are clear."""
    known = getattr(model.medium, "absorption", None)
    return torch.zeros(len(model.medium.indices), 3) if known is None else known.detach().float().cpu()


def without_glass(model: NerfModel) -> NerfModel:
    """The model with straight rays."""
    return variant(model, medium=Vacuum().to(model.device), path_sampler=Straight())


def without_inside(model: NerfModel) -> NerfModel:
    """The model with glass and sky alone."""
    return variant(model, fields=nn.ModuleList(Nothing() for _ in model.fields))


def _of_bodies(model: NerfModel, given: Tensor, known: Tensor, what: str) -> Tensor:
    """Values for all bodies of those that are given: for each, or for the outer one alone."""
    given = given.to(known)
    if not len(known):
        raise NerfroError(f"{what} cannot be set: the model has no bodies on which rays bend")
    if given.shape == known.shape[1:]:
        given = torch.cat([given[None], known[1:]])
    if given.shape != known.shape or not torch.isfinite(given).all() or (given < 0).any():
        raise NerfroError(f"{what}={given.tolist()} is not allowed; give {list(known.shape)} positive numbers")
    return given
