"""Exposure and white balance of photographs, as a gain per view and colour channel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.core.light import saturated


class PerView(nn.Module):
    """Module whose tensors are empty until `begin` or the loading of a checkpoint sets the number of views."""

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, tensor in (*self._parameters.items(), *self._buffers.items()):
            stored = state_dict.get(prefix + name)
            if tensor is not None and stored is not None and len(tensor) == 0:
                tensor.data = stored.new_empty(stored.shape, dtype=tensor.dtype, device=tensor.device)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class Exposure(PerView):
    """Gain of linear radiance for each view and colour channel.

    The mean logarithm of the gains is zero, because the overall brightness of the scene is otherwise ambiguous.
    """

    def __init__(self) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(0, 3))

    def begin(self, num_views: int) -> None:
        """Initialize the gains with 1."""
        self.log_gain.data = self.log_gain.new_zeros(num_views, 3)

    def forward(self, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return self.gains()[view]

    def gains(self) -> Float[Tensor, "V 3"]:
        """Return the gains of all views."""
        return torch.exp(self.log_gain - self.log_gain.mean(0))

    @torch.no_grad()
    def fit(self, view: Int[Tensor, "R"], radiance: Float[Tensor, "R 3"], photographed: Float[Tensor, "R 3"]) -> None:
        """Set the gain of each view to the least-squares ratio of photographed to predicted linear radiance.

        Args:
            view: view of each pixel.
            radiance: predicted linear radiance without gain.
            photographed: linear radiance in the photograph; saturated values are ignored.
        """
        unsaturated = ~saturated(photographed)
        products = torch.stack([photographed * radiance, radiance * radiance]) * unsaturated
        sums = products.new_zeros(2, *self.log_gain.shape).index_add(1, view, products)
        # A black photograph has no gain.
        self.log_gain.copy_(torch.where((sums > 0).all(0), (sums[0] / sums[1]).log(), self.log_gain))

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithmic gains over views."""
        return float(self.gains().detach().log().std(0, unbiased=False).mean())


def fit_gain(
    encode: Callable[[Tensor], Tensor], radiance: Float[Tensor, "Q 3"], target: Float[Tensor, "Q 3"]
) -> Float[Tensor, "3"]:
    """Fit the gain of each channel that best maps rendered radiance to a photograph (Gauss-Newton).

    Args:
        encode: conversion from linear radiance to the colour space of the photograph.
        radiance: rendered linear radiance of each pixel.
        target: colours of the photograph.
    """
    with torch.inference_mode(False), torch.enable_grad():
        radiance, target = radiance.double().clone(), target.double().clone()
        logarithm = torch.zeros(3, dtype=torch.float64, device=radiance.device)
        for _ in range(20):
            log_gains = logarithm.expand_as(radiance).clone().requires_grad_()
            shown = encode(log_gains.exp() * radiance)
            (slope,) = torch.autograd.grad(shown.sum(), log_gains)
            # Pixels that are saturated in both images carry no information.
            clipped = saturated(target) & (shown > 1)
            error, slope = (value.masked_fill(clipped, 0) for value in (shown.detach() - target, slope))
            step = (slope * error).sum(0) / slope.square().sum(0).clamp(min=1e-12)
            logarithm = logarithm - step.clamp(-1, 1)
    return logarithm.exp().float()
