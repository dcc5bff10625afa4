"""Base class of background models, which represent the background radiance."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.func import functional_call

from nerfro.core.types import Exits
from nerfro.data.component import Component


class Background(Component, nn.Module, ABC):
    """Background radiance, C'(d) (paper, Eqn. 5): radiance that arrives from outside of the volume.

    It is in the colour space of the model: linear, or sRGB with `model.colour=srgb`.
    """

    @abstractmethod
    def forward(self, exits: Exits) -> Float[Tensor, "*batch 3"]:
        """Evaluate the background radiance.

        Args:
            exits: last segments of paths. A background at infinity depends only on the directions.

        Returns:
            Radiance of each exit, not negative and without upper bound.
        """

    @property
    def face_resolution(self) -> int:
        """Number of samples along 90 degrees with which exports represent the background."""
        return 256

    @property
    def detail(self) -> float:
        """Angle in degrees of the finest detail that gradient descent learns."""
        return 0.35


def background_radiance(
    background: Background, exits: Exits, teaches: Bool[Tensor, "P"] | None = None
) -> Float[Tensor, "P 3"]:
    """Evaluate the background radiance, with gradients of the parameters from selected exits only.

    Args:
        background: the background.
        exits: last segments of polylines.
        teaches: exits from which the parameters learn; None for all. The exits themselves always have gradients.
    """
    radiance = background(exits)
    if teaches is None or not radiance.requires_grad:
        return radiance
    fixed = radiance.detach()
    if exits.directions.requires_grad:
        parameters = {name: parameter.detach() for name, parameter in background.named_parameters()}
        fixed = functional_call(background, parameters, (exits,))
    return torch.where(teaches[:, None], radiance, fixed)
