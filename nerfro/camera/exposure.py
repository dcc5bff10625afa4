"""How bright each photograph was taken, and in which white balance."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerfro.camera.per_view import PerView


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
