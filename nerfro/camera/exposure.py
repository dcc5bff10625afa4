"""How bright each photograph was taken, and in which white balance."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.camera.per_view import PerView

# Newton's steps to a gain; each doubles the digits.
_STEPS = 20


class Exposure(PerView):
    """A gain of linear radiance for each view and colour channel; their logarithms are zero on average.

    Without that a brighter scene in darker photographs would be as good.
    """

    start: Float[Tensor, "V"]

    def __init__(self) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(0, 3))
        self.register_buffer("start", torch.zeros(0))

    def begin(self, num_views: int, exposures: Float[Tensor, "V"] | None = None) -> None:
        """Start from the views' relative exposures, or from none."""
        self.log_gain.data = self.log_gain.new_zeros(num_views, 3)
        self.start = self.start.new_zeros(num_views) if exposures is None else exposures.log().to(self.start)

    def forward(self, view: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return self.gains()[view]

    def gains(self) -> Float[Tensor, "V 3"]:
        """Of all views."""
        logarithm = self.log_gain + self.start[:, None]
        return torch.exp(logarithm - logarithm.mean(0))

    @property
    def spread(self) -> float:
        """Standard deviation of the gains' logarithms over views."""
        return float(self.gains().detach().log().std(0, unbiased=False).mean())


def fit_gain(
    encode: Callable[[Tensor], Tensor], radiance: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]
) -> Float[Tensor, "3"]:
    """Gain of each channel of linear radiance that brings what it is encoded as nearest to a picture (Gauss-Newton)."""
    with torch.inference_mode(False), torch.enable_grad():
        radiance, target = radiance.double().clone(), target.double().clone()
        logarithm = torch.zeros(3, dtype=torch.float64, device=radiance.device)
        for _ in range(_STEPS):
            each = logarithm.expand_as(radiance).clone().requires_grad_()
            shown = encode(each.exp() * radiance)
            (slope,) = torch.autograd.grad(shown.sum(), each)
            # Saturated pixels tell nothing where the photograph is saturated, too.
            error = torch.where((target >= 1) & (shown > 1), 0.0, shown.detach() - target)
            slope = torch.where((target >= 1) & (shown > 1), 0.0, slope)
            step = (slope * error).sum(0) / slope.square().sum(0).clamp(min=1e-12)
            logarithm = logarithm - step.clamp(-1, 1)
    return logarithm.exp().float()
