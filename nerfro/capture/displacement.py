"""A displacement of a surface by learned B-splines, coarse ones and fine ones together."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.geometry.interpolation import bspline_basis


class Displacement(nn.Module):
    """Outward displacement of a surface in world units: a sum of cubic B-splines on grids over a box.

    The learned coefficients have no unit. A coefficient of 1 moves the surface by the object's size on the coarsest
    grid, and by less on finer ones in proportion to the distance of their control points. One learning rate therefore
    changes the slope of the surface alike on all levels.

    Args:
        shape: number of vertices of the grid at which the displacement is evaluated, along x, y and z.
        size: size of the object, world units.
        levels: control points along each side of the splines, the coarsest grid first.
    """

    def __init__(self, shape: tuple[int, ...], size: float, levels: tuple[int, ...]) -> None:
        super().__init__()
        self.levels = nn.ParameterList(nn.Parameter(torch.zeros(n, n, n)) for n in levels)
        self.scales = [size * levels[0] / n for n in levels]
        self._bases = [[bspline_basis(n, length) for length in shape] for n in levels]

    def forward(self) -> Float[Tensor, "X Y Z"]:
        """Evaluate the displacement at all vertices of the grid."""
        terms = zip(self.scales, self.levels, self._bases, strict=True)
        return sum(scale * torch.einsum("ijk,xi,yj,zk->xyz", values, *bases) for scale, values, bases in terms)  # type: ignore[return-value]

    def roughness(self) -> Float[Tensor, ""]:
        """Return the mean square of second differences between control points, as slopes of the surface."""
        coarsest = len(self.levels[0])
        return sum(  # type: ignore[return-value]
            (values.diff(n=2, dim=axis) * (coarsest * (len(values) - 3) / len(values))).square().mean()
            for values in self.levels
            for axis in range(3)
        )
