"""Homogeneous bodies with a surface: sharp for Snell's law, a thin smooth shell for the Eikonal equation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfro.allowed import NotNegative, Positive, checked
from nerfro.errors import NerfroError
from nerfro.kernels.tolerances import MIN_COSINE, SAFE_SHARE, STEPS_PER_SHELL
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.types import Path
from nerfro.variants import variant

# Absorption per world unit from which learning starts: what is inside must not be explained by it at first.
_ALMOST_CLEAR = 0.02
# Wavelengths of the lines d, F and C, nm.
_FRAUNHOFER = (587.56, 486.13, 656.27)


Self = TypeVar("Self", bound="Solid")  # typing has it from Python 3.11 on


@checked("medium")
class Solid(Medium):
    """Bodies of constant index, bounded by the zero levels of signed distances; later bodies lie inside earlier ones.

    For the Eikonal equation the surface is a shell of half width w around the zero level, in which the index rises as
    a cubic step of the signed distance phi: S = t^2 (3 - 2 t), t = (1 - phi / w) / 2. Body after body,
    n <- n + (ior - n) S; in a `nested` medium with the product of the steps so far in place of S.

    Args:
        iors: refractive index of each body.
        shell: half width w, world units.
        absorption: of red, green and blue per world unit, of each body after the others; one number for all of them,
            none for clear bodies.
        learn_absorption: whether it is learned, from there or from almost nothing.
        abbe: Abbe number of each body, or one for all, where the index depends on the wavelength; the indices are then
            those of the d line, 587.6 nm.
    """

    # Whether a body is only where all before it are too, so that it may reach beyond them and touch without a gap; one
    # of index 1 is air, as outside. Otherwise a point belongs to the last body that holds it.
    nested = False
    iors: Float[Tensor, "K"]  # refractive index of each body; a parameter where it is learned
    _absorption: Float[Tensor, "K 3"] | None  # or, where it is learned, what softplus makes it of

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
        if len(abbe) not in (0, 1, len(iors)):
            raise NerfroError(f"medium.abbe={list(abbe)} has {len(abbe)} numbers; give one for each body, or for all")
        self.abbe = list(abbe)
        if len(absorption) not in (0, 1, 3 * len(iors)):
            raise NerfroError(
                f"medium.absorption={list(absorption)} has {len(absorption)} numbers; give red, green and blue of each "
                f"body ({3 * len(iors)} numbers), or one for all"
            )
        given = torch.tensor(list(absorption) or [0.0], dtype=torch.float32).expand(3 * len(iors)).view(-1, 3)
        if learn_absorption:
            self._absorption = nn.Parameter(given.clamp(min=_ALMOST_CLEAR).expm1().log())
        else:
            self.register_buffer("_absorption", given if given.any() else None, persistent=False)
        # Double precision: kernels ask for it, and a number without dimensions takes on the precision of what it meets.
        indices = torch.tensor(iors, dtype=torch.float64)
        if learn_ior:
            self.iors = nn.Parameter(indices)
        else:
            self.register_buffer("iors", indices, persistent=False)
        self.shell = float(shell)

    @property
    def indices(self) -> Float[Tensor, "K"]:
        return self.iors.detach()

    def with_indices(self, indices: Float[Tensor, "K"]) -> Solid:
        return variant(self, iors=indices.to(self.iors))

    @property
    def absorption(self) -> Float[Tensor, "K 3"] | None:
        """Of each body, for each colour channel, per world unit; None where all are clear."""
        return softplus(self._absorption) if isinstance(self._absorption, nn.Parameter) else self._absorption

    @property
    def disperses(self) -> bool:
        return bool(self.abbe)

    def at_wavelength(self: Self, wavelength: float) -> Self:
        """The same bodies with their indices at a wavelength, nm; gradients reach the indices that they are made of.

        Cauchy's two terms: n(w) = n_d + B (1 / w^2 - 1 / w_d^2), with B from Abbe's V = (n_d - 1) / (n_F - n_C).
        """
        line_d, line_f, line_c = (line**-2 for line in _FRAUNHOFER)
        per_unit = (wavelength**-2 - line_d) / (line_f - line_c) / self.iors.new_tensor(self.abbe)
        return variant(self, iors=self.iors + (self.iors - 1) * per_unit)

    def tinted(self, path: Path) -> Path:
        of_bodies = self.absorption
        if of_bodies is None:
            return path
        return path.changed(absorption=torch.cat([torch.zeros_like(of_bodies[:1]), of_bodies]).to(path.s))

    def bending_parameters(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter is not self._absorption]

    def learned(self) -> dict[str, float]:
        if not isinstance(self._absorption, nn.Parameter):
            return {}
        values = self.absorption.detach()  # type: ignore[union-attr]
        names = [
            f"absorption_{body + 1}_{colour}" for body in range(len(values)) for colour in ("red", "green", "blue")
        ]
        return dict(zip(names, values.flatten().tolist(), strict=True))

    @abstractmethod
    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Signed distance to each body's surface, negative inside, and its gradient; a lower bound far away will do."""

    def regions(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """As `signed_distances`, of what of each body is there: in a `nested` medium what lies in all before it."""
        phi, gradients = self.signed_distances(positions)
        if not self.nested:
            return phi, gradients
        phi, body = phi.cummax(-1)
        return phi, gradients.gather(-2, body[..., None].expand_as(gradients))

    def innermost(self, inside: Bool[Tensor, "*batch K"]) -> Int[Tensor, "*batch"]:
        """Number of the body that a point belongs to, from 1 on, by whether it is within each surface; 0 in none."""
        numbers = torch.arange(inside.shape[-1] + 1, device=inside.device)
        if self.nested:
            # Air in the open is air: a ray goes from the one into the other without an event.
            numbers[1:] *= self.iors != 1
            return numbers[inside.long().cumprod(-1).sum(-1)]
        return torch.where(inside, numbers[1:], 0).amax(-1)

    def index_inside(self, inside: Bool[Tensor, "*batch K"]) -> Float[Tensor, "*batch"]:
        """Index of the body that a point belongs to, 1 in none."""
        return torch.cat([self.iors.new_ones(1), self.iors]).to(self.box)[self.innermost(inside)]

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Index of the smooth shells and its exact gradient."""
        phi, normals = self.signed_distances(positions)
        in_box = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n, gradient = torch.ones_like(phi[..., 0]), torch.zeros_like(positions)
        within, rise = torch.ones_like(n)[..., None], torch.zeros_like(positions)  # product of steps, and its gradient
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
        """Most of the distance to the nearest shell."""
        phi, _ = self.signed_distances(positions)
        return (SAFE_SHARE * phi.abs().amin(-1) - self.shell).clamp(min=0)

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """The shell's width over `STEPS_PER_SHELL`, longer for slanting rays."""
        slope = torch.linalg.vector_norm(gradients, dim=-1)
        # Where there is no gradient there is no normal either; dividing by it would make gradients nan.
        varies = slope > 0
        cosine = ((directions * gradients).sum(-1) / torch.where(varies, slope, 1.0)).abs()
        cosine = torch.where(varies, cosine, 1.0)
        return 2 * self.shell / STEPS_PER_SHELL / cosine.clamp(min=MIN_COSINE)
