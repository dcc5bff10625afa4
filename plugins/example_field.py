"""Template: a radiance field of your own in one file. Use it with `field=blobs`."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.parts import Count, Field, FieldValues, Positive, Samples, register


@register("field", "blobs")
class Blobs(Field):
    """Sum of soft balls, each with a learned position, size, density and colour.

    Args:
        num_blobs: number of balls.
        extent: half side of the cube around the origin outside of which the field is empty, world units.
    """

    def __init__(self, num_blobs: Count = 32, extent: Positive = 1.0) -> None:
        super().__init__()
        self.extent = extent
        self.centres = nn.Parameter(extent * (2 * torch.rand(num_blobs, 3) - 1))
        self.log_sizes = nn.Parameter(torch.full((num_blobs,), 0.3 * extent).log())
        self.log_densities = nn.Parameter(torch.zeros(num_blobs))
        self.colours = nn.Parameter(torch.randn(num_blobs, 3))

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        return self.extent * self.centres.new_tensor([[-1.0] * 3, [1.0] * 3])

    def forward(self, samples: Samples) -> FieldValues:
        offsets = (samples.positions[..., None, :] - self.centres) / self.log_sizes.exp()[:, None]
        densities = torch.exp(self.log_densities - 0.5 * offsets.square().sum(-1))  # [P, N, blobs], per world unit
        density = densities.sum(-1)
        colour = (densities @ self.colours.sigmoid()) / density.clamp(min=1e-6)[..., None]
        inside = (samples.positions.abs() <= self.extent).all(-1)
        return FieldValues(density * inside, colour)
