"""One step of the Eikonal equation in arc length, d/ds (n dx/ds) = grad n.

With v = n dx/ds the equation is x' = v / n, v' = grad n (paper, Eqn. eikonal), and |v| = n along every exact solution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerfro.kernels.tolerances import MIN_NORMAL_PART, RESOLVED

Index = Callable[[Tensor], tuple[Tensor, Tensor]]


class RayState(NamedTuple):
    """Where rays are."""

    positions: Float[Tensor, "R 3"]  # world units
    velocities: Float[Tensor, "R 3"]  # v, direction times refractive index
    # The medium there.
    n: Float[Tensor, "R"]
    gradients: Float[Tensor, "R 3"]


Integrator = Callable[[RayState, Float[Tensor, "R"], Index], RayState]


def euler(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Explicit Euler, x + ds v / n, v + ds grad n, both from the old state (the paper's); |v| drifts away from n."""
    x, v, n, g = state
    x, v = x + (ds / n)[:, None] * v, v + ds[:, None] * g
    return RayState(x, v, *index(x))


def leapfrog(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """Kick, drift, kick with the force n grad n of dx/dsigma = v; second order, one look-up a step.

    dsigma = ds / n with n in the middle of the step, n + ds/2 dn/ds, so that the step is ds long to second order.
    Exact where n^2 is linear in space.

    Where a step does not resolve the index, so that |v| differs from n after it, and where the index stops varying,
    |v| = n is restored by v's component along the kick alone. The component across, n sin(angle) at a surface, is what
    refraction conserves, so a flat interface is refracted exactly however few steps it takes. Steps that resolve the
    index are left alone: the error of |v| does not grow with their number, and what remains of it turns with the
    gradient and is not along the kick. Nor is a small component along the kick (the ray turns) determined by |v| = n.
    """
    _, v, n, g = state
    middle = n + 0.5 * ds * (g * v).sum(-1) / n
    x, kicked, n, g = kick_drift_kick(state, ds / torch.maximum(middle, 0.5 * state.n), index)
    varies = (g != 0).any(-1)
    return RayState(x, _with_length_along(kicked, kicked - v, n, varies), n, g)


def kick_drift_kick(state: RayState, dsigma: Float[Tensor, "R"], index: Index) -> RayState:
    """The step of `leapfrog` in the parameter of dx/dsigma = v, dv/dsigma = n grad n.

    A symplectic map, and its own inverse when v is turned round, for any fixed dsigma.
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
    """Change the component of v along an axis so that |v| becomes `length`, where that is called for (`leapfrog`)."""
    unit = functional.normalize(axis, dim=-1, eps=torch.finfo(v.dtype).tiny)
    along = (v * unit).sum(-1)
    excess = v.square().sum(-1) - length**2
    squared = along**2 - excess
    resolved = varies & (excess.abs() <= RESOLVED * length**2)
    sound = (torch.minimum(along**2, squared) >= MIN_NORMAL_PART * length**2) & ~resolved
    # The root of 1 where it is not used: that of a negative number would make gradients nan.
    change = torch.copysign(torch.where(sound, squared, 1.0).sqrt(), along) - along
    return v + torch.where(sound, change, 0.0)[:, None] * unit


def rk4(state: RayState, ds: Float[Tensor, "R"], index: Index) -> RayState:
    """The classical fourth-order Runge-Kutta step; the length of v is set to n after it."""
    x, v, n, g = state
    ds = ds[:, None]
    x1, v1 = v / n[:, None], g
    n2, v2 = index(x + 0.5 * ds * x1)
    x2 = (v + 0.5 * ds * v1) / n2[:, None]
    n3, v3 = index(x + 0.5 * ds * x2)
    x3 = (v + 0.5 * ds * v2) / n3[:, None]
    n4, v4 = index(x + ds * x3)
    x4 = (v + ds * v3) / n4[:, None]
    x = x + ds / 6 * (x1 + 2 * x2 + 2 * x3 + x4)
    v = v + ds / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
    n, g = index(x)
    return RayState(x, with_length(v, n), n, g)


def with_length(v: Float[Tensor, "R 3"], length: Float[Tensor, "R"]) -> Float[Tensor, "R 3"]:
    """Vectors of the same direction and the given length."""
    return v * (length / v.norm(dim=-1))[:, None]


INTEGRATORS: dict[str, Integrator] = {"euler": euler, "leapfrog": leapfrog, "rk4": rk4}
