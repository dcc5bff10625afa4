"""What a camera part is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Int
from torch import Tensor, nn

from nerfro.rays import Rays


class Camera(nn.Module, ABC):
    """Corrects the rays of training views before they are traced; what it learns is a part of the model."""

    @abstractmethod
    def forward(self, rays: Rays, view: Int[Tensor, "R"]) -> Rays:
        """The rays of views as they are believed to be, given those of the data's cameras."""
