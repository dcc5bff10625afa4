"""Base class of radiance fields, evaluation at selected samples, and the activation of radiance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.light import unbounded_radiance
from nerfro.core.types import FieldValues, Samples
from nerfro.data.component import Component, require_results

# Activation whose squared sigmoid is 1 / 240 in sRGB.
_BLACK = -4.0
Decoder = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps positions and unit directions [points, 3] to density [points] and radiance [points, 3]."""


class Field(Component, nn.Module, ABC):
    """Density and colour of a volume; subclasses implement `forward`.

    Positions and densities are in world units, and directions are unit vectors. Colours are linear radiance, or sRGB
    with `model.colour=srgb`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        contract = "FieldValues with density [P, N] and radiance [P, N, 3] for samples.positions [P, N, 3]"
        require_results(cls, FieldValues, contract, _fits)

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


def _fits(values: FieldValues, samples: Samples) -> bool:
    return values.density.shape == samples.s.shape and values.radiance.shape == samples.positions.shape


def evaluate_selected(decoder: Decoder, samples: Samples, selected: Bool[Tensor, "P N"] | None = None) -> FieldValues:
    """Evaluate a decoder at selected samples that may be occupied; elsewhere, density and radiance are zero.

    On a GPU, counting the selected samples costs one synchronization with the host.

    Args:
        decoder: see `Decoder`.
        samples: all samples.
        selected: samples to evaluate; None for all.
    """
    positions, directions = samples.positions.flatten(0, 1), samples.directions.flatten(0, 1)
    if samples.occupied is not None:
        selected = samples.occupied if selected is None else selected & samples.occupied
    if selected is None:
        density, colour = decoder(positions, directions)
        return FieldValues(density.view(samples.s.shape), colour.view(samples.positions.shape))
    index = selected.flatten().nonzero().squeeze(1)
    density, colour = decoder(positions.index_select(0, index), directions.index_select(0, index))
    # Out of place, so that gradients flow from the full tensors back to the selected samples.
    all_density = density.new_zeros(selected.numel()).index_copy(0, index, density)
    all_radiance = colour.new_zeros(selected.numel(), 3).index_copy(0, index, colour)
    return FieldValues(all_density.view(selected.shape), all_radiance.view(*selected.shape, 3))


def radiance(raw: Float[Tensor, "*batch"], unbounded: bool = False) -> Float[Tensor, "*batch"]:
    """Convert raw outputs to linear radiance: in [0, 1] by a squared sigmoid, or unbounded by a squared softplus.

    The square approximates sRGB, which stores about the root of radiance. Early in training, black explains thin fog in
    front of a bright sky best, and the gradient of a saturated sigmoid would vanish. Therefore gradients that would
    decrease values below `_BLACK`, the smallest pixel value above 0, are blocked.
    """
    raw = _ClampBlack.apply(raw.float())
    return unbounded_radiance(raw) if unbounded else torch.sigmoid(raw).square()


class _ClampBlack(torch.autograd.Function):
    """Clamp values at `_BLACK`; below, pass only gradients that increase the values."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        return raw.clamp(min=_BLACK)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (raw,) = ctx.saved_tensors
        return torch.where((raw < _BLACK) & (gradient > 0), 0.0, gradient)
