"""What a medium is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.errors import NerfroError
from nerfro.types import Path

Scalars = Float[Tensor, "*batch"]
Vectors = Float[Tensor, "*batch 3"]


class lazy_buffer:  # noqa: N801 (used like functools.cached_property)
    """A tensor computed when it is first asked for, and kept as a buffer: it moves to other devices with its module."""

    def __init__(self, compute: Callable[[Any], Tensor]) -> None:
        self._compute, self._name, self.__doc__ = compute, f"_{compute.__name__}", compute.__doc__

    def __get__(self, module: nn.Module, owner: type) -> Tensor:
        if self._name not in module._buffers:
            with torch.inference_mode(False):  # pictures may be the first to ask, but training asks too
                module.register_buffer(self._name, self._compute(module), persistent=False)
        return module.get_buffer(self._name)


# Steps along the diagonal of a medium that says nothing about where its index varies.
_STEPS_PER_DIAGONAL = 512


class Medium(nn.Module, ABC):
    """Refractive index in space; outside its box n = 1 and grad n = 0."""

    box: Float[Tensor, "2 3"]  # lower and upper corner, world units

    @abstractmethod
    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Refractive index and its gradient (per world unit)."""

    @property
    def indices(self) -> Float[Tensor, "K"]:
        """Refractive index of each body; of none where the index is not that of bodies."""
        return torch.empty(0)

    def with_indices(self, indices: Float[Tensor, "K"]) -> Medium:
        """The same bodies of another index."""
        raise NerfroError(f"the index of {type(self).__name__} cannot be changed; take a medium of bodies")

    @property
    def content_box(self) -> Float[Tensor, "2 3"]:
        """Corners of the object's own bounds, world units: what lies inside it lies in here."""
        return self.box

    @property
    def absorption(self) -> Tensor | None:
        """Of each body, for each colour channel, per world unit; None where nothing absorbs."""
        return None

    @property
    def disperses(self) -> bool:
        """Whether the index depends on the wavelength."""
        return False

    def with_absorption(self, path: Path) -> Path:
        """The path with the absorption of the bodies that it crosses."""
        return path

    def bending_parameters(self) -> list[nn.Parameter]:
        """What paths depend on, of all that learns."""
        return list(self.parameters())

    def learned(self) -> dict[str, float]:
        """Physical quantities that learn, by names for the log."""
        return {}

    def clearance(self, positions: Vectors) -> Scalars:
        """Distance around each point of the box within which the index surely does not vary; 0 where unknown."""
        return torch.zeros_like(positions[..., 0])

    def step_length(self, directions: Vectors, gradients: Vectors) -> Scalars:
        """Arc length of a step that resolves the medium, for a ray of that unit direction where grad n is as given."""
        diagonal = torch.linalg.vector_norm(self.box[1] - self.box[0])
        return (diagonal / _STEPS_PER_DIAGONAL).expand(directions.shape[:-1])
