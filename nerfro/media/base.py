"""Base class of media, the refractive index as a function of position, and the medium without an object."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.errors import NerfroError
from nerfro.core.types import WORLD_ORIGIN, Path
from nerfro.geometry.mesh import TriangleMesh
from nerfro.registry.registration import register

Scalars = Float[Tensor, "*batch"]
Vectors = Float[Tensor, "*batch 3"]


class Medium(nn.Module, ABC):
    """Refractive index in space.

    Subclasses implement `forward` and set `box`. Subclasses may override `clearance`, the distance of constant index
    around a point, and `step_length`, the necessary step of the Eikonal integrators.

    Attributes:
        box: lower and upper corner of the medium [2, 3], world units. Outside of the box, n = 1 and grad n = 0.
        origin: world coordinates of the origin of all positions. Objects far from the origin of the world have a
            separate origin, because single precision would not be enough.
        is_vacuum: whether the index is 1 everywhere, so that all rays are straight.
        names: name of each body; empty for media without bodies.
    """

    box: Float[Tensor, "2 3"]
    origin: Float[np.ndarray, "3"] = WORLD_ORIGIN
    is_vacuum = False
    names: Sequence[str] = ()

    @abstractmethod
    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Evaluate the refractive index and its gradient.

        Args:
            positions: points, world units, relative to `origin`.

        Returns:
            n without unit, and grad n per world unit.
        """

    @property
    def bodies(self) -> Any:
        """The `media.bodies.Bodies`, if the medium consists of bodies with sharp surfaces; None otherwise."""
        return None

    @property
    def outline(self) -> TriangleMesh | None:
        """Triangles of all surfaces, whose projection is the silhouette of the medium; None if unknown."""
        return None

    @property
    def iors(self) -> Float[Tensor, "K"]:
        """Refractive index of each body, with gradients, in double precision; empty for media without bodies."""
        return torch.empty(0, dtype=torch.float64)

    @property
    def indices(self) -> Float[Tensor, "K"]:
        """Refractive index of each body, without gradients."""
        return self.iors.detach()

    def with_indices(self, indices: Float[Tensor, "K"]) -> Medium:
        """Return the same bodies with other refractive indices.

        Raises:
            NerfroError: the medium does not consist of bodies.
        """
        raise NerfroError(f"the index of {type(self).__name__} cannot be changed; take a medium of bodies")

    def with_absorption_coefficients(self, absorption: Float[Tensor, "K 3"]) -> Medium:
        """Return the same bodies with other absorption coefficients, per world unit.

        Raises:
            NerfroError: the medium does not consist of bodies.
        """
        raise NerfroError(
            f"{type(self).__name__} has no bodies of constant absorption; leave absorption out, or train with "
            "medium=sdf_grid"
        )

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Corners of the object's bounds, world units."""
        return self.box

    @property
    def absorption(self) -> Tensor | None:
        """Absorption coefficients of each body and colour channel, per world unit; None if nothing absorbs."""
        return None

    @property
    def disperses(self) -> bool:
        """Whether the refractive index depends on the wavelength."""
        return False

    def with_absorption(self, path: Path) -> Path:
        """Return the path with the absorption of all crossed bodies."""
        return path

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        """Return the learned parameters by name, see `Scene.parameters_by_name`."""
        return {f"medium.{name}": parameter for name, parameter in self.named_parameters()}

    def measurements(self) -> dict[str, float]:
        """Return learned physical quantities by name, for the log."""
        return {}

    def clearance(self, positions: Vectors) -> Scalars:
        """Return a lower bound of the distance from each point to a varying index, world units; 0 where unknown."""
        return torch.zeros_like(positions[..., 0])

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """Return the arc length of an integration step fine enough for the medium, world units.

        Args:
            directions: unit directions of rays.
            gradients: grad n where the rays are, per world unit.
        """
        diagonal = torch.linalg.vector_norm(self.box[1] - self.box[0])
        return (diagonal / 512).expand(directions.shape[:-1])


@register("medium", "vacuum")
class Vacuum(Medium):
    """Vacuum: n = 1 everywhere, and every ray is straight."""

    is_vacuum = True

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.zeros(2, 3), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        return torch.ones_like(positions[..., 0]), torch.zeros_like(positions)
