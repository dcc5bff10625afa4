"""Changes of a trained model: another sky, other indices or absorption, no glass, nothing inside, or normals."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.backgrounds.base import ConstantBackground
from nerfro.backgrounds.envmap import EnvironmentMap
from nerfro.core.errors import NerfroError
from nerfro.core.light import to_srgb
from nerfro.core.types import FieldValues, Samples
from nerfro.core.variants import variant
from nerfro.fields.base import Field
from nerfro.media.base import Vacuum
from nerfro.rendering import ColourSpace, Renderer, Scene
from nerfro.samplers.base import Straight


class EmptyField(Field):
    """Radiance field of density zero."""

    def forward(self, samples: Samples) -> FieldValues:
        return FieldValues(torch.zeros_like(samples.s), torch.zeros_like(samples.positions))


class NormalsField(Field):
    """Radiance field whose radiance is the normal of another field, the unit vector against its density gradient.

    Args:
        field: the field.
    """

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field = field

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        return self.field.bounds

    def forward(self, samples: Samples) -> FieldValues:
        density = self.field(samples).density
        normals, solid = torch.zeros_like(samples.positions), density > 0
        if solid.any():
            with torch.inference_mode(False), torch.enable_grad():  # renderings have no gradients otherwise
                positions = samples.positions[solid].clone().requires_grad_()
                # The logarithm gives points of all densities the same weight; the gradient of a field leaves out points
                # of small weight.
                density_there = self.field.density(positions)
                logarithm = density_there.clamp(min=torch.finfo(density_there.dtype).tiny).log()
                (gradient,) = torch.autograd.grad(logarithm.sum(), positions)
            normals[solid] = -nn.functional.normalize(gradient, dim=-1).to(normals)
        return FieldValues(density, normals)


def with_changed_scene(renderer: Renderer, **changes: object) -> Renderer:
    """Copy a renderer with some components of its scene replaced; the copy shares all other components."""
    return variant(renderer, scene=variant(renderer.scene, **changes))


def with_sky(renderer: Renderer, radiance: Float[Tensor, "H 2*H 3"]) -> Renderer:
    """Replace the background by a lat-long image of linear radiance, z up."""
    if radiance.ndim != 3 or radiance.shape[1:] != (2 * len(radiance), 3):
        raise NerfroError(f"a sky of shape {list(radiance.shape)} is no lat-long image; give one of [H, 2 H, 3]")
    radiance = radiance.float()
    if not torch.isfinite(radiance).all() or (radiance < 0).any():
        raise NerfroError("the radiance of a sky must be finite and not negative; correct its values")
    # A face of the cube spans a quarter of the width of the image.
    sky, scene = EnvironmentMap([max(1, radiance.shape[1] // 4)]), renderer.scene
    sky.set_lat_long(to_srgb(radiance) if scene.colour_space is ColourSpace.SRGB else radiance)
    return with_changed_scene(renderer, background=sky.to(scene.device).eval())


def with_indices(renderer: Renderer, ior: Float[Tensor, "*K"]) -> Renderer:
    """Replace the refractive indices: one for each body, or one number for the first body."""
    medium = renderer.scene.medium
    return with_changed_scene(renderer, medium=medium.with_indices(_of_bodies(ior, medium.indices, "ior")))


def with_absorption(renderer: Renderer, absorption: Float[Tensor, "*K 3"]) -> Renderer:
    """Replace the absorption coefficients: three for each body, or three for the first body."""
    medium = renderer.scene.medium
    coefficients = absorption_of(renderer.scene)
    if medium.bodies is not None:
        absorption = _of_bodies(absorption, coefficients, "absorption").to(renderer.scene.device)
    return with_changed_scene(renderer, medium=medium.with_absorption_coefficients(absorption))


def absorption_of(scene: Scene) -> Float[Tensor, "K 3"]:
    """Return the absorption of red, green and blue in each body, per world unit, on the CPU."""
    absorption = scene.medium.absorption
    return torch.zeros(len(scene.medium.indices), 3) if absorption is None else absorption.detach().float().cpu()


def without_glass(renderer: Renderer) -> Renderer:
    """Replace the medium by a vacuum, in which rays are straight."""
    vacuum = Vacuum().to(renderer.scene.device)
    return variant(with_changed_scene(renderer, medium=vacuum), path_sampler=Straight())


def without_inside(renderer: Renderer) -> Renderer:
    """Replace the radiance fields by empty ones, so that only glass and background remain."""
    return with_changed_scene(renderer, fields=nn.ModuleList(EmptyField() for _ in renderer.scene.fields))


def with_normals(renderer: Renderer) -> Renderer:
    """Show normals of the content as linear radiance, before black and without absorption."""
    scene, colours = renderer.scene, ColourSpace.LINEAR
    if scene.medium.absorption is not None:
        renderer = with_absorption(renderer, torch.zeros(len(scene.medium.indices), 3))
    fields = nn.ModuleList(NormalsField(field) for field in scene.fields).eval()  # type: ignore[arg-type]
    black = ConstantBackground().to(scene.device)
    return with_changed_scene(renderer, fields=fields, background=black, colour_space=colours)


def _of_bodies(values: Tensor, current: Tensor, name: str) -> Tensor:
    """Complete values that are given for each body, or for the first body alone, to values for all bodies."""
    values = values.to(current)
    if not len(current):
        raise NerfroError(f"{name} cannot be set: the model has no bodies on which rays bend; leave {name} out")
    if values.shape == current.shape[1:]:
        values = torch.cat([values[None], current[1:]])
    wanted = "positive numbers" if name == "ior" else "numbers that are not negative"
    allowed = values > 0 if name == "ior" else values >= 0
    if values.shape != current.shape or not (torch.isfinite(values) & allowed).all():
        raise NerfroError(f"{name}={values.tolist()} is not allowed; give {list(current.shape)} {wanted}")
    return values
