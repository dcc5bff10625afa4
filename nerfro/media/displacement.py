"""How far a surface has moved: splines that learn, coarse ones and fine ones together."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerfro.geometry.interpolation import bspline_basis, cubic_spline

# Control points a side of the splines whose sum moves a surface.
LEVELS = (12, 24, 48)


class Displacement(nn.Module):
    """How far a surface has moved outwards: a sum of cubic B-splines on grids over a box, world units.

    What learns has no unit: a step of so much moves the coarsest spline by that share of the object's size, and finer
    ones as much less as their control points are nearer. So one learning rate turns the surface alike on all levels.

    Args:
        shape: vertices of the grid on which it is asked, which has the same box.
        box: its corners, world units.
        size: of the object, world units.
    """

    box: Float[Tensor, "2 3"]

    def __init__(self, shape: tuple[int, ...], box: Float[Tensor, "2 3"], size: float) -> None:
        super().__init__()
        self.levels = nn.ParameterList(nn.Parameter(torch.zeros(n, n, n)) for n in LEVELS)
        self.paces = [size * LEVELS[0] / n for n in LEVELS]
        self.register_buffer("box", box, persistent=False)
        self._num_axes = len(shape)
        for level, n in enumerate(LEVELS):
            for axis, length in enumerate(shape):
                self.register_buffer(f"_basis_{level}_{axis}", bspline_basis(n, length), persistent=False)

    def state(self) -> Float[Tensor, "Q"]:
        """A copy of all that learns."""
        return torch.cat([values.detach().flatten() for values in self.levels])

    def forward(self, state: Float[Tensor, "Q"] | None = None) -> Float[Tensor, "X Y Z"]:
        """At all vertices of the grid, as it is or as it was in another state."""
        levels: list[Tensor] = list(self.levels)
        if state is not None:
            parts = state.split([values.numel() for values in levels])
            levels = [part.view(values.shape) for part, values in zip(parts, levels, strict=True)]
        total: Tensor | float = 0.0
        for level, (values, pace) in enumerate(zip(levels, self.paces, strict=True)):
            values = pace * values
            for axis in reversed(range(self._num_axes)):
                basis = self.get_buffer(f"_basis_{level}_{axis}")
                values = torch.tensordot(values, basis, ([axis], [1])).movedim(-1, axis)
            total = total + values
        return total  # type: ignore[return-value]

    def at(self, positions: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P"], Float[Tensor, "P 3"]]:
        """At any places in the box, and its gradient there; both have gradients by what learns alone."""
        parts = [cubic_spline(pace * values, self.box, positions) for values, pace in self._levels_with_paces()]
        first, second = zip(*parts, strict=True)
        return sum(first), sum(second)  # type: ignore[return-value]

    def _levels_with_paces(self) -> zip[tuple[nn.Parameter, float]]:
        return zip(self.levels, self.paces, strict=True)

    def roughness(self) -> Float[Tensor, ""]:
        """Mean squares of second differences between control points, as slopes of the surface."""
        return sum(  # type: ignore[return-value]
            (values.diff(n=2, dim=axis) * (LEVELS[0] * (len(values) - 3) / len(values))).square().mean()
            for values in self.levels
            for axis in range(self._num_axes)
        )
