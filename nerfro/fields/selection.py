"""Evaluation of a field at selected samples."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Bool
from torch import Tensor

from nerfro.core.types import FieldValues, Samples

Decoder = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps positions and unit directions [points, 3] to density [points] and radiance [points, 3]."""


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
        density, radiance = decoder(positions, directions)
        return FieldValues(density.view(samples.s.shape), radiance.view(samples.positions.shape))
    index = selected.flatten().nonzero().squeeze(1)
    density, radiance = decoder(positions.index_select(0, index), directions.index_select(0, index))
    # Out of place, so that gradients flow from the full tensors back to the selected samples.
    all_density = density.new_zeros(selected.numel()).index_copy(0, index, density)
    all_radiance = radiance.new_zeros(selected.numel(), 3).index_copy(0, index, radiance)
    return FieldValues(all_density.view(selected.shape), all_radiance.view(*selected.shape, 3))
