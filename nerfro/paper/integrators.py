"""Single steps of the Eikonal equation in arc length, d/ds (n dx/ds) = grad n.

With v = n dx/ds the equation is x' = v / n, v' = grad n (paper, Eqn. 4), and |v| = n along every exact solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerfro.paper.tolerances import MIN_NORMAL_PART, RESOLVED

Index = Callable[[Tensor], tuple[Tensor, Tensor]]


class RayState(NamedTuple):
    """State of rays.

    Attributes:
        positions: positions in world units.
        velocities: v, the unit direction times the refractive index.
        n: refractive index at the positions.
        gradients: gradient of the index at the positions, per world unit.
    """

    positions: Float[Tensor, "R 3"]
    velocities: Float[Tensor, "R 3"]
    n: Float[Tensor, "R"]
    gradients: Float[Tensor, "R 3"]


Integrator = Callable[[RayState, Float[Tensor, "R"], Index], RayState]


def euler(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Take an explicit Euler step, x + ds v / n and v + ds grad n, both from the old state, as the paper does.

    |v| drifts away from n.
    """
    x, v, n, g = state
    x, v = x + (ds / n)[:, None] * v, v + ds[:, None] * g
    return RayState(x, v, *index(x))


def leapfrog(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Take a kick-drift-kick step with the force n grad n of dx/dsigma = v; second order, with one lookup of the index.

    dsigma = ds / n with the index in the middle of the step, n + ds/2 dn/ds, so that the step has length ds to second
    order. The step is exact where n^2 is linear in space.

    If a step does not resolve the index, so that |v| differs from n, and at the end of a varying index, the component
    of v along the kick is changed so that |v| = n. The component across the kick, n sin(angle) at a surface, is
    conserved by refraction, so a flat interface is refracted exactly in any number of steps. Steps that resolve the
    index are not corrected: their error of |v| does not accumulate, and mostly is not along the kick because the
    gradient turns. A small component along the kick, as of a ray that turns, is not determined by |v| = n.
    """
    _, v, n, g = state
    middle = n + 0.5 * ds * (g * v).sum(-1) / n
    x, kicked, n, g = kick_drift_kick(state, ds / torch.maximum(middle, 0.5 * state.n), index)
    varies = (g != 0).any(-1)
    return RayState(x, _with_length_along(kicked, kicked - v, n, varies), n, g)


def kick_drift_kick(state: RayState, dsigma: Float[Tensor, "R"], index: Index) -> RayState:
    """Take the step of `leapfrog` in the parameter sigma of dx/dsigma = v, dv/dsigma = n grad n.

    For a fixed dsigma, the step is a symplectic map, and its own inverse with reversed v.
    """
    x, v, n, g = state
    dsigma = dsigma[:, None]
    kicked = v + 0.5 * dsigma * n[:, None] * g
    x = x + dsigma * kicked
    n, g = index(x)
    return RayState(x, kicked + 0.5 * dsigma * n[:, None] * g, n, g)


def _with_length_along(
    v: Float[Tensor, "R 3"], axis: Float[Tensor, "R 3"], length: Float[Tensor, "R"], varies: Bool[Tensor, "R"]
) -> Float[Tensor, "R 3"]:
    """Change the component of v along an axis so that |v| equals `length`, under the conditions of `leapfrog`."""
    unit = functional.normalize(axis, dim=-1, eps=torch.finfo(v.dtype).tiny)
    along = (v * unit).sum(-1)
    excess = v.square().sum(-1) - length**2
    squared = along**2 - excess
    resolved = varies & (excess.abs() <= RESOLVED * length**2)
    sound = (torch.minimum(along**2, squared) >= MIN_NORMAL_PART * length**2) & ~resolved
    # Unused roots are taken of 1, because the root of a negative number would make gradients NaN.
    change = torch.copysign(torch.where(sound, squared, 1.0).sqrt(), along) - along
    return v + torch.where(sound, change, 0.0)[:, None] * unit
