"""The base class of backgrounds: radiance from beyond the volume."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.func import functional_call

from nerfro.types import Exits


class Boundary(nn.Module, ABC):
    """Background radiance: light that arrives from beyond the volume, C'(d) of the paper's Eqn. 5."""

    @abstractmethod
    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        """Evaluate the background radiance.

        Args:
            exits: lines on which light arrives; a background at infinity needs their directions alone.

        Returns:
            Linear radiance, at least 0 and without upper bound.
        """


def background_radiance(
    boundary: Boundary, exits: Exits, teaches: Bool[Tensor, "P"] | None = None
) -> Float[Tensor, "P 3"]:
    """Evaluate the background radiance, whose parameters learn from some exits alone.

    Args:
        boundary: the background.
        exits: where polylines leave the volume.
        teaches: exits from which the parameters learn; None for all. What bends the rays learns from all exits.
    """
    radiance = boundary(exits)
    if teaches is None or not radiance.requires_grad:
        return radiance
    fixed = radiance.detach()
    if exits.directions.requires_grad:
        parameters = {name: parameter.detach() for name, parameter in boundary.named_parameters()}
        fixed = functional_call(boundary, parameters, (exits,))
    return torch.where(teaches[:, None], radiance, fixed)
