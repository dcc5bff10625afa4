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
        self._num_axes = len(shape)
        for level, n in enumerate(levels):
            for axis, length in enumerate(shape):
                self.register_buffer(f"_basis_{level}_{axis}", bspline_basis(n, length), persistent=False)

    def forward(self) -> Float[Tensor, "X Y Z"]:
        """Evaluate the displacement at all vertices of the grid."""
        total: Tensor | float = 0.0
        for level, (values, scale) in enumerate(zip(self.levels, self.scales, strict=True)):
            values = scale * values
            for axis in reversed(range(self._num_axes)):
                basis = self.get_buffer(f"_basis_{level}_{axis}")
                values = torch.tensordot(values, basis, ([axis], [1])).movedim(-1, axis)
            total = total + values
        return total  # type: ignore[return-value]

    def roughness(self) -> Float[Tensor, ""]:
        """Return the mean square of second differences between control points, as slopes of the surface."""
        coarsest = len(self.levels[0])
        return sum(  # type: ignore[return-value]
            (values.diff(n=2, dim=axis) * (coarsest * (len(values) - 3) / len(values))).square().mean()
            for values in self.levels
            for axis in range(self._num_axes)
        )
