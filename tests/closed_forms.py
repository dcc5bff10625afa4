"""Media with rays in closed form, and helpers of the tests of optics. Lengths are in world units."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerfro.core.types import Rays
from nerfro.media.base import Medium
from nerfro.media.bodies import Bodies
from nerfro.media.distance_grid import DistanceGrid, DistanceGrids
from nerfro.media.material import Abbe, Material
from nerfro.testing.examples import LuneburgLens as Luneburg
from nerfro.testing.optics import angle

__all__ = ["Luneburg", "angle"]

Squared = Callable[[Tensor], tuple[Tensor, Tensor]]


class FunctionMedium(Medium):
    """Any n^2 and its gradient, without a border."""

    def __init__(self, squared: Squared) -> None:
        super().__init__()
        self.squared = squared
        self.box = torch.tensor([[-100.0] * 3, [100.0] * 3], dtype=torch.float64)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        squared, gradient = self.squared(positions)
        n = squared.sqrt()
        return n, gradient / (2 * n[..., None])


class FreeBodies(Bodies):
    """Bodies whose signed distances a test sets: a subclass in closed form, or `sampled` on grids.

    Args:
        iors: refractive index of each body.
        shell: half width of the smooth shells.
        box: lower and upper corner.
        absorption: coefficients of each body and channel, or one number for all.
        abbe: Abbe number of all bodies.
        learn: learned quantities.
    """

    def __init__(
        self,
        iors: Sequence[float],
        shell: float,
        box: Tensor,
        absorption: Sequence[float] = (0.0,),
        abbe: float | None = None,
        learn: Sequence[str] = (),
    ) -> None:
        Medium.__init__(self)
        self.nested, self.shell, self.meshes, self.grids = False, shell, [], DistanceGrids([])
        names = ["object"] if len(iors) == 1 else [str(number + 1) for number in range(len(iors))]
        sigma = np.broadcast_to(np.reshape(absorption, (-1, min(3, len(absorption)))), (len(iors), 3)).tolist()
        dispersion = None if abbe is None else Abbe(abbe)
        self._set_materials(names, [Material(n, row, dispersion, learn) for n, row in zip(iors, sigma, strict=True)])
        self.register_buffer("box", box, persistent=False)

    @property
    def content_box(self) -> Tensor:
        return self.box


def sampled(
    distances: Iterable[Tensor],
    boxes: Tensor | Sequence[Tensor],
    iors: Sequence[float],
    shell: float,
    **material: object,
) -> FreeBodies:
    """Bodies on grids, from signed distances at the vertices, and the corners of each grid or of all."""
    boxes = [boxes] * len(iors) if isinstance(boxes, Tensor) else boxes
    medium = FreeBodies(iors, shell, boxes[0], **material)
    medium._set_grids(DistanceGrid(values, box) for values, box in zip(distances, boxes, strict=True))
    for body, box in zip(medium.materials, boxes, strict=True):
        body.scale_absorption(0.5 * float((box[1] - box[0]).max()))
    return medium


class Ball(FreeBodies):
    """A ball around the origin."""

    def __init__(self, radius: float = 0.8, ior: float = 1.5, shell: float = 0.002, **material: object) -> None:
        side = 1.05 * radius + shell
        super().__init__([ior], shell, torch.tensor([[-side] * 3, [side] * 3]), **material)
        self.radius = radius
        self.materials[0].scale_absorption(radius)

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        distance = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
        return distance - self.radius, functional.normalize(positions, dim=-1)[..., None, :]


class RoundedBox(FreeBodies):
    """A cube around the origin with rounded edges and corners: a smaller cube, grown by the radius of the edges."""

    def __init__(
        self,
        half_side: float = 0.75,
        edge_radius: float = 0.08,
        ior: float = 1.52,
        shell: float = 0.002,
        **material: object,
    ) -> None:
        side = 1.05 * half_side + shell
        super().__init__([ior], shell, torch.tensor([[-side] * 3, [side] * 3]), **material)
        self.half_side, self.edge_radius = half_side, edge_radius

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        q = positions.abs() - (self.half_side - self.edge_radius)
        outward = q.clamp(min=0)
        outside = torch.linalg.vector_norm(outward, dim=-1, keepdim=True)
        distance = outside + q.amax(-1, keepdim=True).clamp(max=0) - self.edge_radius
        nearest_face = functional.one_hot(q.argmax(-1), 3).to(q)
        direction = torch.where(outside > 0, functional.normalize(outward, dim=-1), nearest_face)
        return distance, (direction * positions.sign())[..., None, :]


class Slab(FreeBodies):
    """A wide plate across the z axis."""

    def __init__(self, thickness: float = 0.5, ior: float = 1.5, shell: float = 0.002) -> None:
        corner = torch.tensor([10.0, 10.0, 0.55 * thickness + shell])
        super().__init__([ior], shell, torch.stack([-corner, corner]))
        self.thickness = thickness

    def signed_distances(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        z = positions[..., 2:]
        normal = torch.cat([torch.zeros_like(positions[..., :2]), z.sign()], -1)
        return z.abs() - 0.5 * self.thickness, normal[..., None, :]


def grid_points(half_side: float, size: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Vertices [X, Y, Z, 3] of a cubic grid around the origin."""
    axis = torch.linspace(-half_side, half_side, size, dtype=dtype)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def make_rays(origins: list | Tensor, directions: list | Tensor, near: float, far: float) -> Rays:
    """Rays in double precision; directions are normalized."""
    o = torch.as_tensor(origins, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.as_tensor(directions, dtype=torch.float64), dim=-1)
    ones = torch.ones(len(o), dtype=torch.float64)
    return Rays(o, d, 0 * ones, near * ones, far * ones)


def beam(heights: Tensor, far: float = 9.0) -> Rays:
    """Parallel rays along +x at the given heights in y."""
    origins = torch.stack([torch.full_like(heights, -3), heights, 0 * heights], -1)
    return make_rays(origins, [[1, 0, 0]] * len(heights), 0.5, far)


def random_rays(num: int, width: float, seed: int, far: float) -> Rays:
    """Rays from all sides through random points of a cube around the origin, from a distance of 3."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)
    targets = width * (torch.rand(num, 3, generator=generator) - 0.5)
    return make_rays(targets - 3 * directions, directions, 0.5, far)


def ball_exits(rays: Rays, radius: float, ior: float | Tensor, centre: Sequence[float] = (0, 0, 0)) -> Tensor:
    """Directions of rays behind a ball, turned by 2 (i - t) with sin i = b / R and sin t = b / (n R)."""
    origins = rays.origins - rays.origins.new_tensor(centre)
    nearest = origins - (origins * rays.directions).sum(-1, keepdim=True) * rays.directions
    impact = torch.linalg.vector_norm(nearest, dim=-1, keepdim=True)
    sine = torch.where(impact < radius, impact / radius, 0.0)
    turn = 2 * (torch.asin(sine) - torch.asin(sine / ior))
    return turn.cos() * rays.directions - turn.sin() * nearest / impact.clamp(min=1e-12)


def luneburg(x: Tensor) -> tuple[Tensor, Tensor]:
    """n^2 = 2 - r^2: x = x0 cos(sigma) + p0 sin(sigma)."""
    return 2 - x.square().sum(-1), -2 * x


def fisheye(x: Tensor) -> tuple[Tensor, Tensor]:
    """Maxwell's, n = 2 / (1 + r^2): rays from P are circles through -P / |P|^2."""
    share = 1 / (1 + x.square().sum(-1))
    return 4 * share**2, -16 * x * (share**3)[..., None]


FIBRE_ALPHA = 0.5


def fibre(x: Tensor) -> tuple[Tensor, Tensor]:
    """n^2 = 1.5^2 (1 - alpha^2 rho^2) around the z axis: ellipses in sigma."""
    across = x * x.new_tensor([1.0, 1.0, 0.0])
    return 2.25 * (1 - FIBRE_ALPHA**2 * across.square().sum(-1)), -2.25 * 2 * FIBRE_ALPHA**2 * across


def layered(before: float, after: float, width: float) -> Squared:
    """A cubic step of n from one index to another over `width` across the plane z = 0."""

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        t = (0.5 + x[..., 2] / width).clamp(0, 1)
        n = before + (after - before) * t * t * (3 - 2 * t)
        slope = (after - before) * 6 * t * (1 - t) / width
        return n**2, 2 * (n * slope)[..., None] * x.new_tensor([0.0, 0.0, 1.0])

    return squared


def blurred_ball(ior: float | Tensor, sigma: float, radius: float | Tensor = 1.0) -> Squared:
    """A ball of constant index whose step to air is smoothed by a Gaussian along the radius."""

    def squared(x: Tensor) -> tuple[Tensor, Tensor]:
        r = x.square().sum(-1).sqrt()
        t = (r - radius) / (sigma * math.sqrt(2))
        n = 1 + 0.5 * (ior - 1) * torch.erfc(t)
        slope = -(ior - 1) * torch.exp(-t * t) / (sigma * math.sqrt(2 * math.pi))
        return n**2, (2 * n * slope / r)[..., None] * x

    return squared
