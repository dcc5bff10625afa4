"""The space that a radiance field covers: a box, all of space in contracted coordinates, or space without bounds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.types import Path
from nerfro.registry.allowed import FURTHEST


def corners_of_box(box_min: Sequence[float], box_max: Sequence[float]) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box as an array.

    Args:
        box_min, box_max: lower and upper corner, world units.

    Raises:
        NerfroError: a corner does not have three numbers or is farther than 10^7 units from the origin, or the lower
            corner is not below the upper one.
    """
    box = np.array([box_min, box_max], np.float64) if len(box_min) == len(box_max) == 3 else np.zeros((2, 3))
    if not (box[1] > box[0]).all() or not (np.abs(box) <= FURTHEST).all():
        raise NerfroError(
            f"box_min={list(box_min)}, box_max={list(box_max)} is not a box; give three numbers each, min below max, "
            f"and none beyond {FURTHEST}"
        )
    return box


# Stand-in for infinity, in units of the ball's radius, or of the line's distance if the line misses the ball.
FAR = 1e4
# Distance from the centre, in radii, below which a line counts as passing through the centre.
NEAREST = 1e-6
# Cells along each side of the grid of observed cells, and number of cameras that must see a cell close to a camera.
_OBSERVED_CELLS, _MIN_CAMERAS = 64, 3

ToArcLength = Callable[[Float[Tensor, "P N"]], Float[Tensor, "P N"]]
Corners = Sequence[Sequence[float]] | Float[np.ndarray, "2 3"] | Float[Tensor, "2 3"]


class Space(nn.Module, ABC):
    """Part of space that a radiance field and its samples cover, and the coordinates of grids over this part.

    The base class has world coordinates. `contract` maps positions to the coordinates of grids, and `scale` is the
    length in these coordinates per world unit.

    Args:
        content: corners of the box around the content, world units; None if it is unknown.

    Attributes:
        has_box: whether the space has a finite box in the coordinates of grids, so that a grid can cover the space.
        infinite: whether the space reaches infinity, so that the background only represents light from infinity.
        near: arc length at which samples begin, world units; None for the near bounds of the rays.
        radius: radius of the ball beyond which space is contracted, world units; 0 without contraction.
        side: longest side of the box.
    """

    has_box: ClassVar[bool] = True
    infinite: ClassVar[bool] = False
    near: float | None = None
    radius: float = 0.0
    content: Float[Tensor, "2 3"] | None
    side: float

    def __init__(self, content: Float[Tensor, "2 3"] | None) -> None:
        super().__init__()
        self.register_buffer("content", None if content is None else content.float(), persistent=False)

    @property
    @abstractmethod
    def box(self) -> Float[Tensor, "2 3"]:
        """Corners of the box of grids over the space, in the coordinates of grids."""

    @property
    def bounds(self) -> Float[Tensor, "2 3"] | None:
        """Corners of the box outside of which the space is empty, world units; None for unbounded spaces."""
        return None

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return 0.5 * (self.box[0] + self.box[1])

    def contract(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Map positions in world units to the coordinates of grids."""
        return x

    def expand(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Invert `contract`; coordinates beyond infinity are mapped to a large distance."""
        return x

    def scale(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*#batch"]:
        """Return the length in the coordinates of grids per world unit, at positions in world units."""
        return x.new_ones(())

    def inside(self, x: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"] | None:
        """Return which positions, in world units, are in the space; None if all are."""
        return None

    def exists(self, x: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*#batch"]:
        """Return which coordinates of grids stand for positions."""
        return x.new_ones((), dtype=torch.bool)

    def cells(self, resolution: int) -> Int[Tensor, "M"] | None:
        """Return the numbers of the cells of a grid that meet the space, by x, y and z; None for all cells."""
        return None

    def span(self, path: Path) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """Return the arc lengths between which paths from near to far may be in the space."""
        return path.near, path.far

    def measure(self, path: Path) -> tuple[Float[Tensor, "P"], ToArcLength]:
        """Measure paths in the space, in the coordinates of grids.

        Returns:
            Length of each path, and a function that converts lengths from 0 to this length to arc lengths.
        """
        first, last = self.span(path)
        return last - first, lambda length: first[:, None] + length

    def observed(self, cameras: Cameras | None = None) -> Bool[Tensor, "cells cells cells"] | None:
        """Find the cells of a coarse grid that photographs can determine, all without cameras.

        The result is None if cameras cannot stand inside the space, so that all cells count as observed.
        """
        return None


class Box(Space):
    """A box in world coordinates.

    Args:
        corners: lower and upper corner, world units.

    Raises:
        NerfroError: the lower corner is not below the upper corner.
    """

    def __init__(self, corners: Corners) -> None:
        box = _corners(corners)
        super().__init__(box)
        self.side = float((box[1] - box[0]).max())

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        assert self.content is not None
        return self.content

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        return self.box

    def inside(self, x: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        return inside_box(x, *self.box)

    def span(self, path: Path) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        return path.span(self.box)


class Unbounded(Space):
    """All of space in world coordinates, from the near to the far bounds of the rays.

    Args:
        content: corners of the box around the content, world units; None if it is unknown.
    """

    has_box = False

    def __init__(self, content: Corners | None = None) -> None:
        super().__init__(None if content is None else _corners(content))

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        raise NerfroError("a space without bounds has no box; give a Box or a Contracted space")

    @property
    def side(self) -> float:  # type: ignore[override]
        return float(self.box.amax())


class Contracted(Space):
    """All of space, contracted outside a ball to the shell between the ball and twice its radius.

    Positions within the ball stay. The offset y from the centre becomes (2 - R / |y|) R y / |y| where |y| > R (Barron
    et al., mip-NeRF 360, 2022, Eqn. 10). Grids cover the cube around contracted space.

    Args:
        content: corners of a box around the content, world units; the ball lies around its centre.
        radius: radius R of the ball, world units.
        near: arc length at which samples begin, world units, or less if a surface is closer.
    """

    infinite = True
    _cube: Float[Tensor, "2 3"]

    def __init__(self, content: Corners, radius: float, near: float = 0.0) -> None:
        box = _corners(content)
        super().__init__(box)
        self.radius, self.near = radius, near
        cube = box.mean(0) + 2 * radius * torch.tensor([[-1.0], [1.0]])
        self.side = float((cube[1] - cube[0]).max())
        self.register_buffer("_cube", cube.float(), persistent=False)

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        return self._cube

    def contract(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        offset = x - self.centre
        share = self.radius / offset.norm(dim=-1, keepdim=True).clamp(min=self.radius)
        return self.centre + (2 - share) * share * offset

    def expand(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        offset = x - self.centre
        norm = offset.norm(dim=-1, keepdim=True).clamp(min=self.radius)
        return self.centre + offset * (self.radius / norm) / (2 - norm / self.radius).clamp(min=1 / FAR)

    def scale(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return min(1, R^2 / |y|^2), which is exact along lines from the centre."""
        return (self.radius**2 / (x - self.centre).square().sum(-1)).clamp(max=1)

    def exists(self, x: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        return (x - self.centre).norm(dim=-1) < 2 * self.radius

    def cells(self, resolution: int) -> Int[Tensor, "M"]:
        edges = torch.linspace(-1, 1, resolution + 1).square()
        nearest = torch.minimum(edges[:-1], edges[1:])
        return ((nearest[:, None, None] + nearest[:, None] + nearest).flatten() < 1).nonzero()[:, 0]

    def measure(self, path: Path) -> tuple[Float[Tensor, "P"], ToArcLength]:
        """Measure paths from `near` to practical infinity.

        If necessary, the first segment is extended backwards, and the last one forwards, beyond the ends of the path.
        """
        assert self.near is not None
        positions, directions, s = (x.detach().double() for x in (path.positions, path.directions, path.s))
        offsets = self.centre - positions
        along = (offsets * directions).sum(-1)
        # Distance of each segment's closest approach from the centre, and arc length there.
        impact = (offsets.square().sum(-1) - along.square()).clamp(min=0).sqrt()
        closest = s + along
        start = torch.cat([s[:, 1:2].clamp(max=self.near), s[:, 1:]], 1)
        end = torch.cat([s[:, 1:], closest[:, -1:] + FAR * impact[:, -1:].clamp(min=self.radius)], 1)
        # Signed contracted length from the closest approach to the start of each segment.
        start_length = contracted_length(start - closest, impact, self.radius)
        lengths = contracted_length(end - closest, impact, self.radius) - start_length
        cumulative = torch.cat([torch.zeros_like(lengths[:, :1]), lengths.cumsum(1)], 1)

        def arc_length(length: Float[Tensor, "P N"]) -> Float[Tensor, "P N"]:
            segment = torch.searchsorted(cumulative, length.contiguous().double()) - 1
            segment = segment.clamp(0, start_length.shape[1] - 1)
            columns = (start_length, closest, impact, cumulative)
            start, middle, distance, before = (values.gather(1, segment) for values in columns)
            return middle + world_length(start + length - before, distance, self.radius)

        return cumulative[:, -1], arc_length

    @torch.no_grad()
    def observed(self, cameras: Cameras | None = None) -> Bool[Tensor, "cells cells cells"]:
        """Find the cells that photographs can determine.

        A cell closer than the radius of the ball to a camera must lie within the images of three cameras, or of all
        cameras if there are fewer; all other cells count as observed. Few rays cross the space close to a camera, and
        where none does, entries of a hash table still contain the content of other cells. Paths count as straight.
        """
        shape, device = [_OBSERVED_CELLS] * 3, self.centre.device
        if cameras is None:
            return torch.ones(shape, dtype=torch.bool, device=device)
        middles = (torch.arange(_OBSERVED_CELLS, device=device) + 0.5) / _OBSERVED_CELLS
        low, high = self.box
        positions = self.expand(low + torch.cartesian_prod(middles, middles, middles) * (high - low))
        close = torch.zeros(len(positions), dtype=torch.bool, device=device)
        for camera_centre in cameras.camera_to_world[:, :, 3].to(self.centre):
            close |= (positions - camera_centre).square().sum(-1) < self.radius**2
        num_cameras = torch.zeros(int(close.sum()), device=device)
        size = torch.tensor([cameras.width, cameras.height], device=device)
        for view in range(len(cameras)):
            pixels, depth = (values[0] for values in cameras.select([view]).project(positions[close]))
            num_cameras += ((pixels >= 0) & (pixels <= size)).all(-1) & (depth > 0)
        observed = torch.ones_like(close)
        observed[close] = num_cameras >= min(_MIN_CAMERAS, len(cameras))
        return observed.view(shape)


def inside_box(
    positions: Float[Tensor, "*batch 3"], low: Float[Tensor, "3"], high: Float[Tensor, "3"]
) -> Bool[Tensor, "*batch"]:
    """Return whether positions lie in an axis-aligned box, including the faces."""
    return ((positions >= low) & (positions <= high)).all(-1)


def contracted_length(
    t: Float[Tensor, "*batch"], impact_parameter: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """Integrate the contraction scale along a line, from the point of closest approach to arc length `t` from there.

    With b = sqrt(max(R^2 - a^2, 0)), half the length of the line within the ball, the result is t where |t| < b, and
    b + R^2 / a (atan(t / a) - atan(b / a)) with the sign of t elsewhere.

    Args:
        t: arc length, world units.
        impact_parameter: distance a of the line from the centre, world units.
        radius: radius R of the ball that is not contracted.
    """
    a = impact_parameter.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    beyond = t.abs().maximum(within)
    angle = torch.atan2(a * (beyond - within), a.square() + beyond * within)
    return t.sign() * (t.abs().minimum(within) + radius**2 / a * angle)


def world_length(
    length: Float[Tensor, "*batch"], impact_parameter: Float[Tensor, "*#batch"], radius: float
) -> Float[Tensor, "*batch"]:
    """Invert `contracted_length` for arc lengths up to `FAR`."""
    a = impact_parameter.clamp(min=NEAREST * radius)
    within = (radius**2 - a.square()).clamp(min=0).sqrt()
    tangent = torch.tan((length.abs() - within).clamp(min=0) * a / radius**2)
    beyond = a * (within + a * tangent) / (a - within * tangent)
    return length.sign() * torch.where(length.abs() <= within, length.abs(), beyond)


def _corners(corners: Corners) -> Float[Tensor, "2 3"]:
    low, high = (np.asarray(corner, np.float64).tolist() for corner in corners)
    return torch.from_numpy(corners_of_box(low, high))
