"""Signed distances of bodies on grids, interpolated by quadratic B-splines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor, nn

from nerfro.geometry.interpolation import quadratic_spline, spline_coefficients
from nerfro.kernels.constants import constant
from nerfro.kernels.tolerances import MIN_SEARCH_STEP
from nerfro.media.base import Scalars, Vectors

# Half width in voxels of the band around the surface in which the distance is exact. It covers the support of the
# spline and the step that brackets the surface.
BAND = 3.0
# Cells along each side of the blocks of the interactive page, which store a lower bound of the distance, and of the
# blocks of the kernels, which store whether they may contain a surface. docs/lab/rendering_speed.md has times for 3 and
# 4 cells.
BLOCK, SURFACE_BLOCK = 4, 3


class DistanceGrid(nn.Module):
    """Signed distance of one body.

    Args:
        distances: at the vertices of the grid, world units; negative inside, positive at the border.
        box: lower and upper corner of the grid, world units.

    Attributes:
        coefficients: coefficients of the quadratic B-spline through the distances.
    """

    distances: Float[Tensor, "X Y Z"]
    coefficients: Float[Tensor, "X Y Z"]
    box: Float[Tensor, "2 3"]

    def __init__(self, distances: Float[Tensor, "X Y Z"], box: Float[Tensor, "2 3"]) -> None:
        super().__init__()
        # Grids are rebuilt from the mesh at every start and do not belong in checkpoints.
        self.register_buffer("box", box, persistent=False)
        self.register_buffer("coefficients", spline_coefficients(distances), persistent=False)
        self.register_buffer("distances", distances, persistent=False)

    @property
    def spacing(self) -> Float[Tensor, "3"]:
        """Distance between neighbouring vertices, world units."""
        return (self.box[1] - self.box[0]) / (constant(self.distances.shape, self.box.device) - 1)

    def forward(self, positions: Vectors) -> tuple[Scalars, Vectors]:
        """Evaluate the spline and its exact gradient.

        Outside of the box, the result is a lower bound of the distance: the nearest point of the box lies at a right or
        obtuse angle between the position and the body, so their distances add up at least as the sides of a right
        triangle.
        """
        nearest = positions.maximum(self.box[0]).minimum(self.box[1])
        phi, gradients = quadratic_spline(self.coefficients, self.box, nearest)
        beyond = positions - nearest
        outside = ((beyond != 0).any(-1)) & (phi > 0)
        distance = torch.where(outside, beyond.square().sum(-1) + phi.square(), 1.0).sqrt()
        along = torch.where(beyond == 0, phi[..., None] * gradients, beyond) / distance[..., None]
        return torch.where(outside, distance, phi), torch.where(outside[..., None], along, gradients)

    def following(self, outwards: Float[Tensor, "X Y Z"]) -> DistanceGrid:
        """Return the distances after a displacement of the surface of the first body.

        Surfaces that are made from the first one follow; see `media.vessel`. By default, the surface stays.

        Args:
            outwards: outward displacement of the first surface at the vertices, world units.
        """
        return self

    def coarse_clearance(self) -> Float[Tensor, "x y z"]:
        """Return a lower bound of the distance to the surface from each block of `BLOCK`^3 cells, for the page."""
        blocks = torch.tensor(self.distances.shape).sub(1).div(BLOCK, rounding_mode="floor").add(1).tolist()
        nearest = self.distances.abs().cpu()
        for axis, count in enumerate(blocks):
            # Neighbouring blocks share their boundary vertices.
            last = torch.arange(count * BLOCK + 1).clamp(max=nearest.shape[axis] - 1)
            nearest = nearest.index_select(axis, last).unfold(axis, BLOCK + 1, BLOCK).amin(-1)
        spacing = self.spacing.cpu()
        # A point is within half a cell diagonal of a vertex, and the spline does not pass exactly through the data.
        margin = 0.5 * torch.linalg.vector_norm(spacing) + 0.25 * spacing.min()
        return (nearest - margin).clamp(min=0)

    def coarse_slopes(self) -> Float[Tensor, "x y z 3 2"]:
        """Bound the derivatives of the spline along the axes in each block of `SURFACE_BLOCK`^3 cells.

        A derivative is a weighted mean of differences of neighbouring coefficients, so their extremes bound it. At the
        border of the grid splines are extrapolated, and the bounds are infinite.
        """
        spacing = self.spacing.cpu()
        values = self._coefficients_of_blocks()
        bounds = []
        for axis in range(3):
            slopes = values.diff(dim=axis) / spacing[axis]
            windows = [SURFACE_BLOCK + 3 - (other == axis) for other in range(3)]
            bounds.append(torch.stack(_extremes(slopes, windows), -1))
        ranges = torch.stack(bounds, -2)
        ranges[self._border_blocks()] = ranges.new_tensor([-torch.inf, torch.inf])
        return ranges

    def empty_blocks(self) -> Int8[Tensor, "x y z"]:
        """Bound the Chebyshev distance to the next block of `SURFACE_BLOCK`^3 cells that may hold the surface.

        Values of blocks inside the body are negative, and 0 means that the block itself may hold the surface. A block
        without sign changes of the coefficients holds no surface, because the values of a spline lie between its
        coefficients. This does not hold at the border of the grid, where splines are extrapolated.
        """
        lowest, highest = _extremes(self._coefficients_of_blocks(), [SURFACE_BLOCK + 3] * 3)
        # A quadratic spline that is extrapolated by half a cell at a corner is a sum of coefficients whose positive
        # weights add up to 2.19 and whose negative weights to -1.19. It is positive if the largest coefficient is less
        # than 1.84 times the smallest.
        outside = lowest > torch.where(self._border_blocks(), highest / 1.8, 0)
        inside = (highest < 0) & ~self._border_blocks()
        distance = (
            scipy.ndimage.distance_transform_cdt((outside | inside).numpy(), "chessboard").clip(0, 127).astype(np.int8)
        )
        return torch.where(inside, -torch.from_numpy(distance), torch.from_numpy(distance))

    def _coefficients_of_blocks(self) -> Float[Tensor, "X Y Z"]:
        """Return the coefficients of all blocks of `SURFACE_BLOCK`^3 cells and their neighbours, on the CPU."""
        values = self.coefficients.detach().cpu()
        for axis, count in enumerate(values.shape):
            blocks = (count - 1) // SURFACE_BLOCK + 1
            values = values.index_select(axis, torch.arange(-1, blocks * SURFACE_BLOCK + 2).clamp(0, count - 1))
        return values

    def _border_blocks(self) -> Bool[Tensor, "x y z"]:
        """Return the blocks of `SURFACE_BLOCK`^3 cells in which splines are extrapolated beyond the grid."""
        axes = []
        for count in self.coefficients.shape:
            block = torch.arange((count - 1) // SURFACE_BLOCK + 1)
            axes.append((block == 0) | ((block + 1) * SURFACE_BLOCK > count - 2))
        x, y, z = axes
        return x[:, None, None] | y[:, None] | z


class DistanceGrids(nn.ModuleList):
    """Distance grids of all bodies of a medium."""

    if TYPE_CHECKING:

        def __iter__(self) -> Iterator[DistanceGrid]: ...  # type: ignore[override]
        def __getitem__(self, body: int) -> DistanceGrid: ...  # type: ignore[override]

    @cached_property
    def packed(self) -> tuple[Any, ...]:
        """The grids as kernels take them: the first fields of `kernels.lookup.Solids`."""
        low, high = np.stack([grid.box.double().cpu().numpy() for grid in self], axis=1)
        shape = np.array([grid.distances.shape for grid in self])
        inverse_spacing = (shape - 1) / (high - low)
        empty, block_start, block_shape = _flat(grid.empty_blocks() for grid in self)
        coefficients, start, _ = _flat(grid.coefficients.detach() for grid in self)
        slopes = np.concatenate([grid.coarse_slopes().numpy().reshape(-1, 3, 2) for grid in self])
        return (
            low, high, inverse_spacing, MIN_SEARCH_STEP * (high - low).min(1), coefficients, start, shape,
            slopes, empty, block_start, block_shape, inverse_spacing / SURFACE_BLOCK,
        )  # fmt: skip


def _flat(values: Iterable[Tensor]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three-dimensional arrays one after another, with the first element and the shape of each."""
    arrays = [value.cpu().numpy() for value in values]
    starts = np.cumsum([0, *(array.size for array in arrays[:-1])])
    flat = arrays[0].reshape(-1) if len(arrays) == 1 else np.concatenate([array.reshape(-1) for array in arrays])
    return flat, starts, np.array([array.shape for array in arrays])


def _extremes(values: Float[Tensor, "X Y Z"], windows: list[int]) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest value [x, y, z] in windows along each axis that are `SURFACE_BLOCK` apart."""
    lowest = highest = values
    for axis, window in enumerate(windows):
        lowest = lowest.unfold(axis, window, SURFACE_BLOCK).amin(-1)
        highest = highest.unfold(axis, window, SURFACE_BLOCK).amax(-1)
    return lowest, highest
