"""Exposure and white balance of photographs, as a gain per view and colour channel."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.camera.per_view import PerView

# Number of Gauss-Newton steps that fit a gain.
_STEPS = 20


class Exposure(PerView):
    """Gain of linear radiance for each view and colour channel.

    The mean logarithm of the gains is zero, because the overall brightness of the scene is otherwise ambiguous.
    """

    start: Float[Tensor, "V"]

    def __init__(self) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(0, 3))
        self.register_buffer("start", torch.zeros(0))

    def begin(self, num_views: int, exposures: Float[Tensor, "V"] | None = None) -> None:
        """Initialize the gains with the relative exposures of the views, or with 1."""
        self.log_gain.data = self.log_gain.new_zeros(num_views, 3)
        self.start = self.start.new_zeros(num_views) if exposures is None else exposures.log().to(self.start)

    def forward(self, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return self.gains()[view]

    def gains(self) -> Float[Tensor, "V 3"]:
        """Return the gains of all views."""
        logarithm = self.log_gain + self.start[:, None]
        return torch.exp(logarithm - logarithm.mean(0))

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithmic gains over views."""
        return float(self.gains().detach().log().std(0, unbiased=False).mean())


def fit_gain(
    encode: Callable[[Tensor], Tensor], radiance: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]
) -> Float[Tensor, "3"]:
    """Fit the gain of each channel that best maps rendered radiance to a photograph (Gauss-Newton).

    Args:
        encode: conversion from linear radiance to the colour space of the photograph.
        radiance: rendered linear radiance of each pixel.
        target: colours of the photograph in [0, 1].
    """
    with torch.inference_mode(False), torch.enable_grad():
        radiance, target = radiance.double().clone(), target.double().clone()
        logarithm = torch.zeros(3, dtype=torch.float64, device=radiance.device)
        for _ in range(_STEPS):
            each = logarithm.expand_as(radiance).clone().requires_grad_()
            shown = encode(each.exp() * radiance)
            (slope,) = torch.autograd.grad(shown.sum(), each)
            # Pixels that are saturated in both images carry no information.
            error = torch.where((target >= 1) & (shown > 1), 0.0, shown.detach() - target)
            slope = torch.where((target >= 1) & (shown > 1), 0.0, slope)
            step = (slope * error).sum(0) / slope.square().sum(0).clamp(min=1e-12)
            logarithm = logarithm - step.clamp(-1, 1)
    return logarithm.exp().float()
