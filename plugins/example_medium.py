"""Template: a medium of your own in one file. Use it with `medium=gradient_rod sampler/path=eikonal`."""

from __future__ import annotations

import torch

from nerfro.parts import Medium, Positive, Scalars, Vectors, register


@register("medium", "gradient_rod")
class GradientRod(Medium):
    """Rod whose refractive index falls from its axis to 1 at its surface; it focuses light like a lens.

    Args:
        ior: refractive index on the axis.
        radius: radius, world units.
        length: length along z, world units.
    """

    def __init__(self, ior: Positive = 1.5, radius: Positive = 0.5, length: Positive = 2.0) -> None:
        super().__init__()
        self.ior, self.radius = ior, radius
        corner = torch.tensor([radius, radius, length / 2])
        self.register_buffer("box", torch.stack([-corner, corner]), persistent=False)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        across = positions * positions.new_tensor([1, 1, 0]) / self.radius
        squared = across.square().sum(-1)
        inside = (squared < 1) & (positions[..., 2].abs() < self.box[1, 2])
        n = torch.where(inside, self.ior + (1 - self.ior) * squared, 1.0)
        gradient = 2 * (1 - self.ior) * across / self.radius
        return n, torch.where(inside[..., None], gradient, 0.0)
