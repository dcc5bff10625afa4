"""Homogeneous bodies with sharp surfaces for Snell's law, or thin smooth shells for the Eikonal equation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.types import Path
from nerfro.core.variants import variant
from nerfro.kernels.constants import constant
from nerfro.kernels.tolerances import MIN_COSINE, SAFE_SHARE, STEPS_PER_SHELL
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.media.material import Material, materials_of
from nerfro.registry.allowed import NotNegative, Positive, validated

_COLOURS = ("red", "green", "blue")
# Paths record bodies as 8-bit integers.
_MAX_BODIES = 127

Self = TypeVar("Self", bound="Solid")  # typing has it from Python 3.11 on


@validated("medium")
class Solid(Medium):
    """Bodies of constant index, bounded by the zero levels of signed distances; the last body at a point decides.

    For the Eikonal equation the surface is a shell of half width w around the zero level. In the shell the index rises
    as a cubic step of the signed distance phi: S = t^2 (3 - 2 t), t = (1 - phi / w) / 2. The bodies are applied in
    order, n <- n + (ior - n) S; a `nested` medium uses the product of all steps so far in place of S.

    Args:
        iors: refractive index of each body.
        shell: half width w, world units.
        absorption: coefficients per world unit: red, green and blue of the first body, then of the next. A single
            number holds for all bodies and channels; an empty list makes clear bodies.
        learn_absorption: learn the absorption, starting from the given values or from almost none.
        abbe: Abbe number of each body, or one for all bodies; the refractive index then depends on the wavelength, and
            `iors` are those of the d line, 587.6 nm. An empty list switches dispersion off.
        learn_ior: learn the refractive indices.

    Attributes:
        nested: whether a body exists only where all bodies before it exist. A nested body may then reach beyond the
            others and touch them without a gap, and a clear body of index 1 is air, as outside. Otherwise a point
            belongs to the last body that contains it.
        materials: material of each body.
        names: name of each body.
    """

    nested = False
    materials: Sequence[Material]

    def __init__(
        self,
        iors: Sequence[Positive],
        shell: Positive,
        absorption: Sequence[NotNegative] = (),
        learn_absorption: bool = False,
        abbe: Sequence[Positive] = (),
        learn_ior: bool = False,
    ) -> None:
        super().__init__()
        self._set_materials(materials_of(iors, absorption, learn_absorption, abbe, learn_ior))
        self.shell = float(shell)

    def _set_materials(self, materials: Sequence[Material], names: Sequence[str] = ()) -> None:
        if len(materials) > _MAX_BODIES:
            raise NerfroError(f"the medium has {len(materials)} bodies; at most {_MAX_BODIES} are allowed")
        if materials and "ior" in materials[0].learned() and materials[0].ior.item() == 1:
            raise NerfroError(
                "the refractive index of the first body is learned from 1, the index of air, where its surface bends "
                "no ray and the index has no gradient; start from another value, such as 1.3"
            )
        self.materials = nn.ModuleList(materials)  # type: ignore[assignment]
        self.names = list(names) or body_names(len(materials))

    def scale_absorption(self, bounds: Iterable[Float[Tensor, "2 3"]]) -> None:
        """Set learned absorptions to their initial values, from the bounds of each body or its grid in world units.

        Constructors call this method once, so that the training is independent of the world unit.
        """
        for material, box in zip(self.materials, bounds, strict=True):
            material.scale_absorption(0.5 * float((box[1] - box[0]).max()))

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in (self.box[1] - self.box[0]).tolist())
        return f"{type(self).__name__}(ior={[round(n, 4) for n in self.indices.tolist()]}, box of {size})"

    @property
    def iors(self) -> Float[Tensor, "K"]:
        """Refractive index of each body, with gradients, in double precision."""
        return torch.stack([material.ior for material in self.materials])

    @property
    def indices(self) -> Float[Tensor, "K"]:
        return self.iors.detach()

    def with_indices(self: Self, indices: Float[Tensor, "K"]) -> Self:
        return self._with_materials([{"ior": ior} for ior in indices.to(self.iors).unbind()])

    @property
    def absorption(self) -> Float[Tensor, "K 3"] | None:
        """Absorption coefficients of each body and colour channel, per world unit; None if all bodies are clear."""
        if not any(material.absorbs for material in self.materials):
            return None
        return torch.stack([material.absorption for material in self.materials])

    @property
    def absorbs(self) -> Bool[Tensor, "K"]:
        """Whether each body may absorb light."""
        return constant(tuple(material.absorbs for material in self.materials), self.box.device, torch.bool)

    def with_absorption_coefficients(self: Self, absorption: Float[Tensor, "K 3"]) -> Self:
        """Return the same bodies with other coefficients, per world unit."""
        return self._with_materials([{"_absorption": values if values.any() else None} for values in absorption])

    @property
    def disperses(self) -> bool:
        return any(material.dispersion is not None for material in self.materials)

    def achromatic(self: Self) -> Self:
        """Return the same bodies with the index of the d line at all wavelengths."""
        return self._with_materials([{"dispersion": None}] * len(self.materials))

    def at_wavelength(self: Self, wavelength: float) -> Self:
        """Return the same bodies with their indices at a wavelength in nm; gradients reach the original indices."""
        same: dict[str, object] = {"dispersion": None}
        changes = [same | {"ior": material.ior_at(wavelength)} for material in self.materials]
        return self._with_materials(changes)

    def _with_materials(self: Self, changes: Sequence[dict[str, object]]) -> Self:
        changed = [variant(material, **change) for material, change in zip(self.materials, changes, strict=True)]
        return variant(self, materials=nn.ModuleList(changed))

    def with_absorption(self, path: Path) -> Path:
        of_bodies = self.absorption
        if of_bodies is None:
            return path
        return replace(path, absorption=torch.cat([torch.zeros_like(of_bodies[:1]), of_bodies]).to(path.s))

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        found = super().parameters_by_name()
        found = {name: found[name] for name in found if not name.startswith("medium.materials.")}
        for body, material in zip(self.names, self.materials, strict=True):
            found |= {f"bodies.{body}.material.{name}": parameter for name, parameter in material.learned().items()}
        return found

    def measurements(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for body, material in zip(self.names, self.materials, strict=True):
            for quantity in material.learned():
                name, value = f"bodies.{body}.material.{quantity}", getattr(material, quantity).tolist()
                of_colours = zip(_COLOURS, value, strict=True) if quantity == "absorption" else ()
                found |= {f"{name}.{colour}": each for colour, each in of_colours} or {name: value}
        return found

    @abstractmethod
    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Evaluate the signed distance to the surface of each body, negative inside, and its gradient.

        Far from a surface, a lower bound of the distance suffices.
        """

    def regions(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Evaluate `signed_distances`; in a `nested` medium, of the part of each body inside all bodies before it."""
        phi, gradients = self.signed_distances(positions)
        if not self.nested:
            return phi, gradients
        phi, body = phi.cummax(-1)
        return phi, gradients.gather(-2, body[..., None].expand_as(gradients))

    def deciding_body(self, inside: Bool[Tensor, "*batch K"]) -> Int[Tensor, "*batch"]:
        """Return the number of the body that decides the index and absorption at a point, from 1; 0 in air.

        Args:
            inside: whether the surface of each body encloses the point.
        """
        numbers = torch.arange(inside.shape[-1] + 1, device=inside.device)
        if self.nested:
            # Air in a vessel is the air outside: a ray passes between them without an event.
            numbers[1:] *= (self.iors != 1) | self.absorbs
            return numbers[inside.long().cumprod(-1).sum(-1)]
        return torch.where(inside, numbers[1:], 0).amax(-1)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Evaluate the refractive index of the smooth shells and its exact gradient."""
        phi, normals = self.signed_distances(positions)
        in_box = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n, gradient = torch.ones_like(phi[..., 0]), torch.zeros_like(positions)
        within, rise = (
            torch.ones_like(n)[..., None],
            torch.zeros_like(positions),
        )  # product of steps, its gradient
        for body, ior in enumerate(self.iors.unbind()):
            t = (0.5 - 0.5 * phi[..., body] / self.shell).clamp(0, 1)
            step = (t * t * (3 - 2 * t))[..., None]
            slope = (6 * t * (1 - t) * (-0.5 / self.shell))[..., None] * normals[..., body, :]
            if self.nested:
                step, slope = within * step, rise * step + within * slope
                within, rise = step, slope
            gradient = gradient * (1 - step) + (ior - n)[..., None] * slope
            n = n + (ior - n) * step[..., 0]
        return torch.where(in_box, n, 1.0), torch.where(in_box[..., None], gradient, 0.0)

    def clearance(self, positions: Vectors) -> Scalars:
        """Return a lower bound of the distance to the nearest shell, world units."""
        phi, _ = self.signed_distances(positions)
        return (SAFE_SHARE * phi.abs().amin(-1) - self.shell).clamp(min=0)

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """Return the width of the shell over `STEPS_PER_SHELL`, divided by the cosine of incidence."""
        slope = torch.linalg.vector_norm(gradients, dim=-1)
        # Dividing by a gradient of zero would make derivatives nan.
        varies = slope > 0
        cosine = ((directions * gradients).sum(-1) / torch.where(varies, slope, 1.0)).abs()
        cosine = torch.where(varies, cosine, 1.0)
        return 2 * self.shell / STEPS_PER_SHELL / cosine.clamp(min=MIN_COSINE)


def body_names(num_bodies: int) -> list[str]:
    """Return the names of bodies to which the configuration gives none: `object` for one, numbers for several."""
    return ["object"] if num_bodies == 1 else [str(body + 1) for body in range(num_bodies)]
