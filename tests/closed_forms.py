"""Media whose rays are known in closed form, and what tests of optics share. Lengths are in world units."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nerfro.media.base import Medium
from nerfro.types import Rays

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


def make_rays(origins: list | Tensor, directions: list | Tensor, near: float, far: float) -> Rays:
    """Rays in double precision; directions are normalised."""
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


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle between unit vectors in degrees, exact for small ones."""
    return torch.rad2deg(2 * torch.asin((0.5 * torch.linalg.vector_norm(a.double() - b.double(), dim=-1)).clamp(max=1)))


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


SECH_ALPHA = 1.2


def sech_fibre(x: Tensor) -> tuple[Tensor, Tensor]:
    """n = 1.5 sech(alpha rho) around the z axis: sinh(alpha rho) = sinh(alpha rho0) cos(alpha z)."""
    across = x * x.new_tensor([1.0, 1.0, 0.0])
    rho = across.square().sum(-1).sqrt().clamp(min=1e-12)
    n = 1.5 / torch.cosh(SECH_ALPHA * rho)
    return n**2, (-2 * SECH_ALPHA * n**2 * torch.tanh(SECH_ALPHA * rho) / rho)[..., None] * across


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
