"""Homogeneous bodies with a surface: sharp for Snell's law, a thin smooth shell for the Eikonal equation."""

from __future__ import annotations

from abc import abstractmethod

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from nerfro.allowed import Positive, checked
from nerfro.kernels.tolerances import MIN_COSINE, SAFE_SHARE, STEPS_PER_SHELL
from nerfro.media.base import Medium, Scalars, Vectors


@checked("medium")
class Solid(Medium):
    """Bodies of constant index, bounded by the zero levels of signed distances; later bodies lie inside earlier ones.

    For the Eikonal equation the surface is a shell of half width w around the zero level, in which the index rises as
    a cubic step of the signed distance phi: S = t^2 (3 - 2 t), t = (1 - phi / w) / 2. Body after body,
    n <- n + (ior - n) S.

    Attributes:
        shell: half width w, world units.
    """

    iors: Float[Tensor, "K"]  # refractive index of each body; a parameter where it is learned

    def __init__(self, iors: list[Positive], shell: Positive, learn_ior: bool = False) -> None:
        super().__init__()
        # Double precision: kernels ask for it, and a number without dimensions takes on the precision of what it meets.
        indices = torch.tensor(iors, dtype=torch.float64)
        if learn_ior:
            self.iors = nn.Parameter(indices)
        else:
            self.register_buffer("iors", indices, persistent=False)
        self.shell = float(shell)

    @abstractmethod
    def signed_distances(self, positions: Vectors) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 3"]]:
        """Signed distance to each body's surface, negative inside, and its gradient; a lower bound far away will do."""

    @staticmethod
    def innermost(inside: Bool[Tensor, "*batch K"]) -> Int[Tensor, "*batch"]:
        """Number of the last body that a point is in, from 1 on; 0 in none."""
        numbers = torch.arange(1, inside.shape[-1] + 1, device=inside.device)
        return torch.where(inside, numbers, 0).amax(-1)

    def index_inside(self, inside: Bool[Tensor, "*batch K"]) -> Float[Tensor, "*batch"]:
        """Index of the last body that a point is in, 1 in none."""
        n = torch.ones(inside.shape[:-1], dtype=self.box.dtype, device=inside.device)
        for body, ior in enumerate(self.iors.unbind()):
            n = torch.where(inside[..., body], ior, n)
        return n

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Index of the smooth shells and its exact gradient."""
        phi, normals = self.signed_distances(positions)
        in_box = ((positions >= self.box[0]) & (positions <= self.box[1])).all(-1)
        n, gradient = torch.ones_like(phi[..., 0]), torch.zeros_like(positions)
        for body, ior in enumerate(self.iors.unbind()):
            t = (0.5 - 0.5 * phi[..., body] / self.shell).clamp(0, 1)
            step = (t * t * (3 - 2 * t))[..., None]
            slope = (ior - n) * 6 * t * (1 - t) * (-0.5 / self.shell)
            gradient = gradient * (1 - step) + slope[..., None] * normals[..., body, :]
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
