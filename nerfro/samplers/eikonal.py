"""Rays bent by a continuous refractive index."""

from __future__ import annotations

from typing import Literal

import torch

from nerfro.errors import NerfroError
from nerfro.media.base import Medium
from nerfro.registry import register
from nerfro.samplers.base import PathSampler
from nerfro.samplers.integrators import INTEGRATORS, Integrator, RayState
from nerfro.types import Path, Rays


@register("sampler/path", "eikonal")
class Eikonal(PathSampler):
    """Paths that solve the Eikonal equation in steps of equal arc length (the paper's, with integrator euler)."""

    def __init__(self, integrator: Literal["leapfrog", "rk4", "euler"] = "leapfrog", num_steps: int = 768) -> None:
        """Choose how to step.

        Args:
            integrator: euler is the paper's; leapfrog and rk4 hold |v| = n.
            num_steps: vertices of a path, evenly spaced from near to far.
        """
        super().__init__()
        if num_steps < 2:
            raise NerfroError(f"sampler.path.num_steps={num_steps} makes no path; give at least 2 (the paper: 768)")
        self.integrator = integrator
        self.num_steps = num_steps

    @torch.no_grad()
    def forward(self, rays: Rays, medium: Medium) -> Path:
        """Trace every ray from near to far; all vertices are kept."""
        return march_uniform(rays, medium, INTEGRATORS[self.integrator], self.num_steps)


def march_uniform(rays: Rays, medium: Medium, integrator: Integrator, num_steps: int) -> Path:
    """Vertices at equal steps ds = (far - near) / (num_steps - 1) (paper, Eqn. eikonal).

    s is the length of the polyline. The refractive index at near is taken to be 1.
    """
    ds = (rays.far - rays.near) / (num_steps - 1)
    x = rays.origins + rays.near[:, None] * rays.directions
    state = RayState(x, rays.directions, *medium(x))
    states = [state]
    for _ in range(num_steps - 1):
        state = integrator(state, ds, medium)
        states.append(state)
    positions = torch.stack([state.positions for state in states], 1)
    velocities = torch.stack([state.velocities for state in states], 1)
    directions = velocities / velocities.norm(dim=-1, keepdim=True)
    lengths = (positions[:, 1:] - positions[:, :-1]).norm(dim=-1)
    s = torch.cat([rays.near[:, None], rays.near[:, None] + lengths.cumsum(-1)], -1)
    refracted = torch.stack([(state.gradients != 0).any(-1) for state in states], -1).any(-1)
    return Path(positions, directions, s, directions[:, -1], refracted, rays.radii)
