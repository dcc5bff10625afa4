"""Base class of radiance fields."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.types import FieldValues, Samples
from nerfro.data.component import Component


class Field(Component, nn.Module, ABC):
    """Density and colour of a volume; subclasses implement `forward`.

    Positions and densities are in world units, and directions are unit vectors. Colours are linear radiance, or sRGB
    with `model.colour=srgb`.
    """

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        """Opposite corners of the box outside of which the field is empty, world units; None for unbounded fields."""
        return None

    def begin(self, cameras: Cameras) -> None:
        """Prepare for training on photographs of these cameras."""

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Evaluate only the density, per world unit, in single precision; density is independent of the direction."""
        return self.at_points(positions, positions.new_tensor([0.0, 0.0, -1.0]).expand_as(positions))[0]

    def at_points(
        self, positions: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, " points"], Float[Tensor, "points 3"]]:
        """Evaluate density and colour at points, seen in unit directions, in single precision."""
        zeros = torch.zeros(len(positions), 2, device=positions.device)
        values = self(Samples(positions[:, None], directions[:, None], zeros[:, :1], zeros, zeros[:, 0]))
        return values.density[:, 0].float(), values.radiance[:, 0].float()

    @abstractmethod
    def forward(self, samples: Samples) -> FieldValues:
        """Evaluate density (per world unit) and colour at samples.

        Args:
            samples: N samples on each of P polylines.

        Returns:
            Density [P, N] and colour [P, N, 3].
        """
